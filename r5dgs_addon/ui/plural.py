"""Counts and name lists for messages: "1 object", "40,000 Gaussians bend", "mug, ball and 3 more"."""

from collections.abc import Sequence

_NAMED = 5


def of(count: int, noun: str, verb: str = "") -> str:
    """Format a count with its noun and, optionally, a verb.

    Args:
        count: Number of things.
        noun: Singular noun; the plural adds s.
        verb: Plural form of the verb; the singular adds s.
    """
    one = count == 1
    things = f"{count:,} {noun}{'' if one else 's'}"
    return f"{things} {verb}{'s' if one else ''}" if verb else things


def names(found: Sequence[str]) -> str:
    """List the first few names and the number of the others."""
    listed = ", ".join(found[:_NAMED])
    return listed if len(found) <= _NAMED else f"{listed} and {len(found) - _NAMED:,} more"

"""Amounts in messages: "1 object", "40,000 Gaussians bend", "mug, ball and 3 more"."""

from collections.abc import Sequence

_NAMED = 5


def of(count: int, noun: str, verb: str = "") -> str:
    """A number of things in words for the user, and what they do.

    Args:
        count: How many.
        noun: What one is called; the plural ends in s.
        verb: What several do; what one does ends in s.
    """
    one = count == 1
    things = f"{count:,} {noun}{'' if one else 's'}"
    return f"{things} {verb}{'s' if one else ''}" if verb else things


def names(found: Sequence[str]) -> str:
    """The first of some names, and the number of the others."""
    listed = ", ".join(found[:_NAMED])
    return listed if len(found) <= _NAMED else f"{listed} and {len(found) - _NAMED:,} more"

"""Names of files and objects as they may be printed."""

from __future__ import annotations


def shown(text: str) -> str:
    """Return the text with control characters escaped, so that they reach no terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)

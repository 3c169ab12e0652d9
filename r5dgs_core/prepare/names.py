"""Matching of camera names between videos, calibrations and tables: cam_0 is camera 0."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence


def match(wanted: Sequence[str], given: Sequence[str]) -> dict[str, str] | None:
    """Find the given name of each wanted name.

    Names are compared exactly, then without case and suffix, then by the last number in them. The first comparison that
    matches every wanted name to a name of its own is used.

    Returns:
        Given name by wanted name; None if no comparison matches all.
    """
    for key in _KEYS:
        found = _matches(wanted, given, key)
        if len(found) == len(wanted):
            return found
    return None


def unmatched(wanted: Sequence[str], given: Sequence[str]) -> list[str]:
    """Return the wanted names without a given name of their own, by the comparison that matches most."""
    found = max((_matches(wanted, given, key) for key in _KEYS), key=len)
    return [name for name in wanted if name not in found]


def _matches(wanted: Sequence[str], given: Sequence[str], key: Callable[[str], str]) -> dict[str, str]:
    """Return the given name of each wanted name if they alone have the same key."""
    by_key: dict[str, list[str]] = {}
    for name in given:
        by_key.setdefault(key(name), []).append(name)
    mine = Counter(map(key, wanted))
    return {name: by_key[k][0] for name in wanted if (k := key(name)) and mine[k] == len(by_key.get(k, [])) == 1}


def _plain(name: str) -> str:
    return re.sub(r"\.\w{1,4}$", "", name).lower()


def _number(name: str) -> str:
    numbers = re.findall(r"\d+", _plain(name))
    return str(int(numbers[-1])) if numbers else ""


_KEYS = (str, _plain, _number)

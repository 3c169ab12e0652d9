"""Matching of camera names between videos, calibrations and tables: cam_0 is camera 0."""

from __future__ import annotations

import re
from collections.abc import Sequence


def match(wanted: Sequence[str], given: Sequence[str]) -> dict[str, str] | None:
    """Find the given name of each wanted name.

    Names are compared exactly, then without case and suffix, then by the last number in them. The first comparison that
    matches every wanted name to a name of its own is used.

    Returns:
        Given name by wanted name; None if no comparison matches all.
    """
    for key in (str, _plain, _number):
        by_key: dict[str, list[str]] = {}
        for name in given:
            if key(name):
                by_key.setdefault(key(name), []).append(name)
        found = {name: by_key.get(key(name), []) for name in wanted}
        if all(len(names) == 1 for names in found.values()):
            matched = {name: names[0] for name, names in found.items()}
            if len(set(matched.values())) == len(wanted):
                return matched
    return None


def _plain(name: str) -> str:
    return re.sub(r"\.\w{1,4}$", "", name).lower()


def _number(name: str) -> str:
    numbers = re.findall(r"\d+", _plain(name))
    return str(int(numbers[-1])) if numbers else ""

"""Registry of the kinds of motion by name.

Each is imported when it is first looked up, because its module imports `motion_model`, which looks up kinds.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Mapping
from typing import Any

MENU_NUMBERS = {
    "static": 0,
    "translation": 1,
    "ballistic_spin": 2,
    "constant_twist": 3,
    "world_twist": 4,
    "free_top": 5,
    "drag": 6,
    "friction": 7,
    "precession": 8,
    "bounce": 9,
    "two_oscillations": 10,
    "trajectory": 11,
}
"""Kinds in the order of Blender's menu, each the module of this room that defines `KIND`.

.blend files store the numbers: do not change one.
"""


class _Kinds(Mapping[str, Any]):
    """Read-only view of the kinds (`base.MotionKind`) by name."""

    def __getitem__(self, name: str) -> Any:
        return _load(name)

    def __contains__(self, name: object) -> bool:
        return name in MENU_NUMBERS

    def __iter__(self) -> Iterator[str]:
        return iter(MENU_NUMBERS)

    def __len__(self) -> int:
        return len(MENU_NUMBERS)


@functools.cache
def _load(name: str) -> Any:
    if name not in MENU_NUMBERS:
        raise KeyError(name)
    return importlib.import_module(f".{name}", __package__).KIND


KINDS = _Kinds()
"""Kinds by name, in the order of Blender's menu."""

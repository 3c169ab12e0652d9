"""Indoor scenes: closed rooms with area lights, in which every object has its own motion."""

from __future__ import annotations

from collections.abc import Callable

from building import motion

from . import chessboard, darkroom, dining, factory, nonrigid

SCENES: dict[str, Callable[[], list[motion.Actor]]] = {
    "dining": dining.build,
    "chessboard": chessboard.build,
    "darkroom": darkroom.build,
    "factory": factory.build,
    "nonrigid": nonrigid.build,
}
"""Each builds its scene into the open file, animated, and returns its objects in the order of their ids."""

FOV_DEG = {"dining": 50.0, "chessboard": 43.0, "darkroom": 46.0, "factory": 50.0, "nonrigid": 50.0}
"""Horizontal field of view of the cameras of each scene."""

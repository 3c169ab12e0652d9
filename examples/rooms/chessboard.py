"""Chessboard: eight pieces slide, jump, spin, roll, topple or stand on a board."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
from building import materials, motion, shapes, stage
from building.motion import Actor
from mathutils import Quaternion

from . import room

SQUARE = 0.32
BOARD_TOP = 0.6
GAP = 0.004
"""Gap between a piece and the board, so that no two surfaces coincide."""


def build() -> list[Actor]:
    """Build the scene into the open file.

    Returns:
        Its objects, animated, in the order of their ids.
    """
    _room()
    top = BOARD_TOP + GAP
    pale, dark = _wood()
    lying = Quaternion((0, 0, 1), math.radians(12.0)) @ Quaternion((1, 0, 0), -0.5 * math.pi)
    actors = [
        Actor(_king("white king", pale)),
        Actor(_queen("black queen", dark), motion.slide((1.12, 1.12, top), 180.0, 1.5, 1.25, 0.0, 60.0)),
        Actor(_rook("white rook", pale), motion.glide((-1.12, -0.8, top), (1.15, 0, 0), (-0.3, 0, 0), speed_deg=35.0)),
        Actor(_rook("black rook", dark), motion.glide((1.12, -0.42, top), (0, 0.35, 0), (0, 0.75, 0))),
        Actor(
            _knight("white knight", pale),
            motion.glide((-1.05, 0.1, top), (0.55, 0.5, 1.9), (0, 0, -3.8), start_deg=-60.0, speed_deg=110.0),
        ),
        Actor(_bishop("black bishop", dark), motion.spin((-0.16, -0.16, top), (0, 0, 1), 60.0, rate_deg=150.0)),
        Actor(_pawn("black pawn", dark), motion.roll((0.05, -1.1, top + 0.16), 12.0, 0.75, -0.2, 0.16, tilt=lying)),
        Actor(_toppling("white pawn", pale), motion.spin((0.62, 0.12, top), (0, 1, 0), 4.0, rate_deg=112.0)),
    ]
    actors[0].ob.location = (-0.48, 1.12, top)
    motion.perform(actors)
    return actors


def _room() -> None:
    room.new()
    floor = materials.planks("herringbone", ((0.30, 0.16, 0.08), (0.22, 0.11, 0.05), (0.08, 0.04, 0.02)), 0.3)
    wall = materials.speckled("silk", (0.24, 0.34, 0.30), (0.36, 0.46, 0.38), 2.0, sharp=0.8)
    room.build(floor, wall, materials.plain("ceiling", (0.72, 0.70, 0.66)))
    walnut = materials.speckled("walnut", (0.12, 0.05, 0.025), (0.20, 0.09, 0.045), 6.0)
    room.skirting(walnut)
    room.shelf("Books", 1.4, 1.35, walnut)
    art = materials.speckled("landscape", (0.10, 0.24, 0.09), (0.60, 0.64, 0.66), 1.8, sharp=0.5)
    room.picture("Landscape", -1.2, 1.9, (1.5, 1.0), materials.plain("gilt", (0.48, 0.32, 0.08)), art)
    half = 4 * SQUARE
    squares = [materials.plain("square light", (0.70, 0.56, 0.36)), materials.plain("square dark", (0.16, 0.07, 0.04))]
    board = shapes.grid("Squares", (2 * half, 2 * half), (8, 8), squares, lambda i, j: (i + j + 1) % 2)
    board.location = (-half, -half, BOARD_TOP)
    edge = 2 * half + 0.24
    shapes.box("Board", (edge, edge, 0.1), [walnut], center=(0, 0, BOARD_TOP - 0.052), bevel=0.02)
    shapes.box("Table", (0.9, 0.9, BOARD_TOP - 0.102), [walnut], center=(0, 0, 0.5 * (BOARD_TOP - 0.102)), taper=0.7)
    stage.area_light("Ceiling light", (-0.9, -1.6, 3.25), (0.0, 0.0, 0.6), (1.6, 1.2), 165.0, (1.0, 0.92, 0.80))
    stage.area_light("Window", (3.4, -0.6, 1.9), (-0.5, 0.2, 0.6), (1.6, 1.4), 85.0, (0.80, 0.88, 1.0))


def _wood() -> tuple[list[bpy.types.Material], list[bpy.types.Material]]:
    """Wood and inlay of the white and of the black pieces."""
    pale = materials.speckled("boxwood", (0.66, 0.48, 0.26), (0.80, 0.64, 0.40), 9.0, sharp=0.6)
    dark = materials.speckled("rosewood", (0.06, 0.03, 0.03), (0.22, 0.07, 0.05), 9.0, sharp=0.6)
    return [pale, materials.plain("inlay red", (0.58, 0.08, 0.05))], [
        dark,
        materials.plain("inlay green", (0.08, 0.42, 0.26)),
    ]


def _turned(name: str, profile: Sequence[tuple[float, float]], skins: list[bpy.types.Material], rows: Sequence[int]):
    """A turned piece on a common foot; the given rows of faces are inlaid over three eighths of the circumference."""
    foot = [(0.0, 0.0), (0.15, 0.0), (0.16, 0.03), (0.15, 0.07), (0.12, 0.09)]
    return shapes.lathe(name, [*foot, *profile], skins, lambda row, k: int(row in (2, *rows) and k % 24 < 9))


def _king(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    profile = [
        (0.085, 0.16),
        (0.07, 0.36),
        (0.085, 0.44),
        (0.13, 0.47),
        (0.085, 0.50),
        (0.12, 0.68),
        (0.09, 0.71),
        (0.0, 0.74),
    ]
    ob = _turned(name, profile, skins, (5, 9))
    for size in ((0.035, 0.03, 0.13), (0.12, 0.03, 0.035)):
        shapes.box(f"{name} cross", size, [skins[1]], center=(0, 0, 0.79), parent=ob)
    return ob


def _queen(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    profile = [
        (0.08, 0.16),
        (0.065, 0.34),
        (0.08, 0.40),
        (0.12, 0.43),
        (0.075, 0.46),
        (0.14, 0.62),
        (0.10, 0.60),
        (0.0, 0.66),
    ]
    ob = _turned(name, profile, skins, (5, 9))
    shapes.ball(f"{name} pearl", 0.045, [skins[1]], lambda row, k: 0, rings=8, segments=16, parent=ob).location = (
        0,
        0,
        0.68,
    )
    return ob


def _rook(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    profile = [(0.11, 0.13), (0.10, 0.36), (0.14, 0.39), (0.14, 0.42), (0.0, 0.42)]
    ob = _turned(name, profile, skins, (5,))
    for k in range(6):
        angle = math.tau * k / 6
        part = shapes.box(f"{name} merlon", (0.05, 0.08, 0.08), [skins[int(k == 0)]], parent=ob)
        part.location, part.rotation_euler = (0.112 * math.cos(angle), 0.112 * math.sin(angle), 0.455), (0, 0, angle)
    return ob


def _knight(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    """A horse's head that looks along +x."""
    ob = _turned(name, [(0.11, 0.12), (0.0, 0.13)], skins, ())
    outline = [
        (-0.10, 0.12),
        (0.09, 0.12),
        (0.05, 0.26),
        (0.17, 0.29),
        (0.18, 0.37),
        (0.04, 0.46),
        (0.0, 0.53),
        (-0.04, 0.46),
    ]
    outline += [(-0.11, 0.36), (-0.12, 0.22)]
    head = shapes.prism(f"{name} head", outline, -0.055, 0.055, [skins[0], skins[0]], parent=ob)
    head.rotation_euler = (0.5 * math.pi, 0, 0)
    shapes.box(f"{name} mane", (0.05, 0.06, 0.26), [skins[1]], center=(-0.115, 0, 0.31), parent=ob)
    shapes.box(f"{name} noseband", (0.04, 0.125, 0.05), [skins[1]], center=(0.12, 0, 0.335), parent=ob)
    return ob


def _bishop(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    profile = [
        (0.075, 0.15),
        (0.06, 0.30),
        (0.075, 0.35),
        (0.115, 0.38),
        (0.07, 0.40),
        (0.11, 0.47),
        (0.10, 0.54),
        (0.03, 0.63),
    ]
    ob = _turned(name, [*profile, (0.0, 0.64)], skins, (5, 10))
    shapes.ball(f"{name} knob", 0.035, [skins[1]], lambda row, k: 0, rings=8, segments=16, parent=ob).location = (
        0,
        0,
        0.655,
    )
    return ob


def _pawn(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    profile = [
        (0.075, 0.14),
        (0.06, 0.22),
        (0.10, 0.25),
        (0.06, 0.27),
        (0.10, 0.31),
        (0.115, 0.37),
        (0.09, 0.43),
        (0.0, 0.47),
    ]
    return _turned(name, profile, skins, (5, 10))


def _toppling(name: str, skins: list[bpy.types.Material]) -> bpy.types.Object:
    """A pawn with its origin at the edge of its foot towards +x, so that it can tip over that edge."""
    root = shapes.empty(name)
    pawn = _pawn(f"{name} body", skins)
    pawn.parent, pawn.location = root, (-0.15, 0, 0)
    return root

"""Dining room: a laid table; eight objects roll, slide, spin, fly, swing or stand."""

from __future__ import annotations

import math

import bpy
from building import materials, motion, shapes, stage, toys
from building.motion import Actor

from . import room

TABLE_TOP = 0.74
GAP = 0.004
"""Gap between an object and its support, so that no two surfaces coincide."""


def build() -> list[Actor]:
    """Build the scene into the open file.

    Returns:
        Its objects, animated, in the order of their ids.
    """
    _room()
    top = TABLE_TOP + GAP
    actors = [
        Actor(_lamp("lamp"), motion.swing((0.1, 0.15, 3.27), (0.2, 1.0, 0.0), 11.0, 2.1, -50.0)),
        Actor(_chair("chair"), motion.slide((-1.18, 0.1, GAP), 188.0, 0.6, 1.2, 0.0, 60.0)),
        Actor(_stool("stool"), motion.spin((1.24, -0.25, GAP), (0, 0, 1), 70.0, rate_deg=110.0)),
        Actor(_plate("plate"), motion.spin((-0.56, -0.22, top), (0, 0, 1), 190.0, rate_deg=-70.0)),
        Actor(_orange("orange", 0.17), motion.roll((-0.1, -0.34, top + 0.17), 6.0, 1.05, -0.35, 0.17)),
        Actor(_teapot("teapot"), motion.slide((0.72, 0.26, top), 176.0, 0.95, 1.3, 20.0, 75.0)),
        Actor(
            toys.beach_ball("ball", 0.18),
            motion.throw((-0.95, 0.64, 1.1), (1.75, -0.15, 1.35), 2.9, (0.3, 1, 0.2), 200.0),
        ),
        Actor(_mill("pepper mill")),
    ]
    actors[-1].ob.location = (-0.48, 0.24, top)
    motion.perform(actors)
    return actors


def _room() -> None:
    room.new()
    floor = materials.planks("parquet", ((0.36, 0.20, 0.10), (0.27, 0.14, 0.07), (0.12, 0.06, 0.03)), 0.34)
    wall = materials.speckled("wallpaper", (0.50, 0.55, 0.44), (0.66, 0.66, 0.52), 2.4, sharp=0.8)
    ceiling = materials.plain("ceiling", (0.75, 0.74, 0.70))
    room.build(floor, wall, ceiling)
    white, wood = materials.plain("skirting", (0.68, 0.66, 0.60)), materials.plain("frame", (0.20, 0.10, 0.05))
    room.skirting(white)
    room.picture(
        "Seascape", -1.1, 1.9, (1.3, 0.9), wood, materials.speckled("sea", (0.04, 0.16, 0.34), (0.62, 0.58, 0.40), 2.2)
    )
    room.picture(
        "Still life",
        1.2,
        1.8,
        (0.8, 1.0),
        wood,
        materials.speckled("fruit", (0.42, 0.07, 0.04), (0.70, 0.50, 0.10), 4.0, sharp=0.7),
    )
    oak = materials.planks("oak", ((0.52, 0.36, 0.20), (0.45, 0.30, 0.16), (0.30, 0.18, 0.09)), 0.24)
    shapes.box("Table top", (1.8, 1.2, 0.07), [oak], bevel=0.02).location = (0, 0, TABLE_TOP - 0.035)
    room.legs("Table", (-0.78, 0.78), (-0.48, 0.48), TABLE_TOP - 0.07, 0.1, materials=[wood])
    cloth = materials.checks("runner", ((0.62, 0.60, 0.55), (0.10, 0.22, 0.42)), 0.12)
    rug = shapes.grid(
        "Rug",
        (3.4, 2.6),
        (1, 1),
        [materials.speckled("rug", (0.34, 0.06, 0.05), (0.50, 0.34, 0.18), 3.0, sharp=0.85)],
        lambda i, j: 0,
    )
    rug.location = (-1.7, -1.5, 0.002)
    side = shapes.box("Sideboard", (1.5, 0.45, 0.85), [oak], bevel=0.02)
    side.location = (2.3, 2.0, 0.43)
    shapes.box("Sideboard cloth", (0.9, 0.46, 0.03), [cloth], center=(2.3, 2.0, 0.872))
    stage.area_light("Ceiling light", (0.8, -1.6, 3.25), (0.0, 0.0, 0.6), (1.8, 1.2), 125.0, (1.0, 0.93, 0.82))
    stage.area_light("Window", (-3.4, -0.8, 1.9), (0.5, 0.2, 0.7), (1.6, 1.4), 60.0, (0.80, 0.90, 1.0))


def _lamp(name: str) -> bpy.types.Object:
    """An unlit shade on a rod, hung from its origin."""
    root = shapes.empty(name)
    brass = materials.plain("brass", (0.40, 0.26, 0.07))
    shapes.rod(f"{name} rod", 0.022, -1.12, -0.01, [brass], parent=root)
    skins = [
        materials.plain("shade red", (0.46, 0.07, 0.05)),
        materials.plain("shade cream", (0.62, 0.54, 0.36)),
        brass,
    ]
    profile = [(0.30, -1.45), (0.28, -1.38), (0.24, -1.28), (0.16, -1.16), (0.05, -1.10), (0.0, -1.10)]
    shapes.lathe(f"{name} shade", profile, skins, lambda row, k: 2 if row in (0, 4) else k // 6 % 2, parent=root)
    return root


def _chair(name: str) -> bpy.types.Object:
    """A chair that faces +x."""
    root = shapes.empty(name)
    wood = materials.speckled("chair wood", (0.30, 0.14, 0.05), (0.44, 0.23, 0.09), 7.0)
    seat = materials.checks("seat", ((0.10, 0.32, 0.20), (0.66, 0.60, 0.40)), 0.115)
    for x in (-0.19, 0.19):
        for y in (-0.19, 0.19):
            shapes.box(f"{name} leg", (0.055, 0.055, 0.42), [wood], center=(x, y, 0.21), parent=root)
    shapes.box(f"{name} seat", (0.46, 0.46, 0.06), [seat], center=(0, 0, 0.45), bevel=0.015, parent=root)
    for y in (-0.19, 0.19):
        shapes.box(f"{name} post", (0.05, 0.05, 0.5), [wood], center=(-0.2, y, 0.73), parent=root)
    for z in (0.66, 0.82, 0.97):
        shapes.box(f"{name} slat", (0.035, 0.38, 0.09), [seat if z > 0.9 else wood], center=(-0.2, 0, z), parent=root)
    return root


def _stool(name: str) -> bpy.types.Object:
    """A round stool whose seat has coloured sectors."""
    colors = ((0.10, 0.20, 0.45), (0.72, 0.62, 0.38), (0.50, 0.10, 0.08), (0.72, 0.62, 0.38))
    skins = [materials.plain(f"stool {k}", color) for k, color in enumerate(colors)]
    profile = [
        (0.0, 0.0),
        (0.22, 0.0),
        (0.22, 0.04),
        (0.05, 0.07),
        (0.05, 0.46),
        (0.26, 0.48),
        (0.27, 0.56),
        (0.0, 0.57),
    ]
    return shapes.lathe(name, profile, skins, lambda row, k: k // 8 % 4 if row != 3 else 0, segments=32)


def _plate(name: str) -> bpy.types.Object:
    """A plate with a rim of uneven sectors."""
    skins = [materials.plain("china", (0.78, 0.78, 0.74)), materials.plain("cobalt", (0.05, 0.12, 0.42))]
    skins.append(materials.plain("rim gold", (0.62, 0.40, 0.08)))
    profile = [(0.0, 0.0), (0.14, 0.0), (0.27, 0.045), (0.275, 0.055), (0.15, 0.02), (0.08, 0.018), (0.0, 0.018)]

    def material_at(row: int, k: int) -> int:
        return 1 + k // 16 % 2 if row in (1, 3) and k % 16 < 9 else 2 if row == 5 and k < 24 else 0

    return shapes.lathe(name, profile, skins, material_at)


def _orange(name: str, radius: float) -> bpy.types.Object:
    """An orange with a green pole and patches of peel."""
    peel = materials.speckled("peel", (0.80, 0.30, 0.02), (0.66, 0.14, 0.01), 7.0, sharp=0.85)
    green = materials.plain("stalk", (0.10, 0.28, 0.05))
    return shapes.ball(name, radius, [peel, green], lambda row, k: int(row > 20))


def _teapot(name: str) -> bpy.types.Object:
    """A round pot with a spout and a handle."""
    glaze, white = materials.plain("glaze", (0.03, 0.30, 0.34)), materials.plain("pot white", (0.78, 0.74, 0.64))
    profile = [
        (0.0, 0.0),
        (0.12, 0.0),
        (0.19, 0.06),
        (0.22, 0.14),
        (0.20, 0.22),
        (0.13, 0.28),
        (0.12, 0.29),
        (0.04, 0.32),
    ]
    profile += [(0.03, 0.34), (0.045, 0.365), (0.0, 0.38)]
    root = shapes.lathe(
        name, profile, [glaze, white], lambda row, k: int(row in (6, 7) or (row in (2, 3) and k % 12 < 5))
    )
    spout = shapes.rod(f"{name} spout", 0.035, 0.0, 0.2, [white], parent=root)
    spout.location, spout.rotation_euler = (0.17, 0, 0.12), (0, math.radians(48), 0)
    for center, size in (
        ((-0.27, 0, 0.21), (0.13, 0.04, 0.035)),
        ((-0.32, 0, 0.15), (0.035, 0.04, 0.15)),
        ((-0.26, 0, 0.09), (0.13, 0.04, 0.035)),
    ):
        shapes.box(f"{name} handle", size, [white], center=center, parent=root)
    return root


def _mill(name: str) -> bpy.types.Object:
    """A turned pepper mill."""
    skins = [materials.plain("mill dark", (0.16, 0.06, 0.03)), materials.plain("mill light", (0.60, 0.38, 0.16))]
    profile = [
        (0.0, 0.0),
        (0.11, 0.0),
        (0.115, 0.08),
        (0.075, 0.17),
        (0.07, 0.22),
        (0.11, 0.31),
        (0.09, 0.37),
        (0.05, 0.39),
    ]
    profile += [(0.085, 0.44), (0.06, 0.50), (0.0, 0.52)]
    return shapes.lathe(name, profile, skins, lambda row, k: (row // 2) % 2)

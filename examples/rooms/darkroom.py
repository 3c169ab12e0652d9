"""Darkroom: eight objects under a red safelight and two dim coloured lamps."""

from __future__ import annotations

import math

import bpy
from building import materials, motion, shapes, stage
from building.motion import Actor
from mathutils import Quaternion

from . import room

BENCH_TOP = 0.72
GAP = 0.004
"""Gap between an object and its support, so that no two surfaces coincide."""


def build() -> list[Actor]:
    """Build the scene into the open file.

    Returns:
        Its objects, animated, in the order of their ids.
    """
    _room()
    top = BENCH_TOP + GAP
    upright = Quaternion((1, 0, 0), 0.5 * math.pi)
    along = Quaternion((0, 0, 1), math.radians(-4.0)) @ upright
    actors = [
        Actor(_reel("film reel", 0.33), motion.spin((-1.0, 0.72, 1.62), (0, 1, 0), 60.0, rate_deg=190.0, tilt=upright)),
        Actor(
            _canister("canister", 0.19, 0.46), motion.roll((-1.0, -1.2, GAP + 0.19), -4.0, 1.25, 0.4, 0.19, tilt=along)
        ),
        Actor(_tray("tray"), motion.slide((-0.75, 0.42, top), 3.0, 1.2, 1.2, 10.0, -70.0)),
        Actor(_strip("film strip"), motion.swing((0.85, 0.62, 2.2), (0.35, 1.0, 0.0), 16.0, 2.3, 125.0)),
        Actor(_door("cabinet door"), motion.spin((1.5, -0.05, 0.0), (0, 0, 1), -35.0, rate_deg=-75.0)),
        Actor(_can("film can"), motion.throw((1.1, 0.1, 1.15), (-1.45, -0.35, 2.0), 3.7, (0.5, 0.6, 1.0), 160.0)),
        Actor(_trolley("trolley"), motion.drive((-0.15, -0.12, GAP), 0.55, 190.0, 95.0, -25.0)),
        Actor(_tank("developing tank")),
    ]
    actors[-1].ob.location = (0.85, 0.5, top)
    motion.perform(actors)
    return actors


def _room() -> None:
    room.new()
    floor = materials.planks("tiles", ((0.26, 0.25, 0.27), (0.18, 0.17, 0.19), (0.05, 0.05, 0.05)), 0.3)
    wall = materials.speckled("dark plaster", (0.14, 0.13, 0.16), (0.27, 0.25, 0.27), 2.2, sharp=0.8)
    room.build(floor, wall, materials.plain("ceiling", (0.16, 0.16, 0.17)))
    iron = materials.plain("iron", (0.16, 0.16, 0.18))
    room.skirting(iron)
    prints = materials.speckled("print", (0.06, 0.06, 0.06), (0.70, 0.70, 0.68), 3.0, sharp=0.6)
    for k, x in enumerate((-1.9, -0.1, 1.9)):
        room.picture(f"Print {k}", x, 1.75 + 0.12 * (k % 2), (0.75, 0.95), iron, prints)
    bench = materials.planks("bench", ((0.40, 0.33, 0.27), (0.33, 0.27, 0.22), (0.16, 0.12, 0.09)), 0.2)
    shapes.box("Bench top", (2.7, 0.9, 0.08), [bench], bevel=0.015).location = (0, 0.55, BENCH_TOP - 0.04)
    room.legs("Bench", (-1.24, 1.24), (0.2, 0.9), BENCH_TOP - 0.08, 0.1, materials=[iron])
    shapes.box("Reel stand", (0.08, 0.06, 1.1), [iron], center=(-1.0, 0.86, BENCH_TOP + 0.55))
    line = shapes.rod("Line", 0.012, room.LOW[0], room.HIGH[0], [iron])
    line.location, line.rotation_euler = (0, 0.62, 2.25), (0, 0.5 * math.pi, 0)
    chest = materials.speckled("chest", (0.20, 0.22, 0.16), (0.34, 0.34, 0.24), 4.0, sharp=0.7)
    shapes.box("Cabinet", (0.75, 0.6, 0.62), [chest], center=(1.9, 0.05, 0.31), bevel=0.015)
    stage.area_light("Safelight", (1.8, -1.2, 2.9), (0.2, 0.2, 0.6), (0.9, 0.6), 50.0, (1.0, 0.22, 0.12))
    stage.area_light("Amber lamp", (-2.2, -1.6, 2.8), (-0.2, 0.2, 0.6), (0.6, 0.6), 38.0, (1.0, 0.72, 0.36))
    stage.area_light("Blue lamp", (-0.4, 2.0, 3.0), (0.0, 0.0, 0.6), (0.8, 0.4), 30.0, (0.30, 0.46, 1.0))


def _reel(name: str, radius: float) -> bpy.types.Object:
    """A reel about its z axis, with spokes of different colours."""
    skins = [materials.plain("reel grey", (0.62, 0.62, 0.60)), materials.plain("film", (0.10, 0.06, 0.05))]
    skins += [materials.plain("reel mark", (0.70, 0.52, 0.06)), materials.plain("reel teal", (0.04, 0.36, 0.36))]
    profile = [
        (0.0, -0.06),
        (0.09, -0.06),
        (radius - 0.05, -0.06),
        (radius, -0.06),
        (radius, -0.035),
        (radius - 0.04, -0.03),
    ]
    profile += [
        (radius - 0.04, 0.03),
        (radius, 0.035),
        (radius, 0.06),
        (radius - 0.05, 0.06),
        (0.09, 0.06),
        (0.0, 0.06),
    ]

    def material_at(row: int, k: int) -> int:
        if row in (1, 9):
            return (0, 1, 2, 1, 3, 1)[k // 8]
        return 1 if row == 5 else 0

    return shapes.lathe(name, profile, skins, material_at)


def _canister(name: str, radius: float, length: float) -> bpy.types.Object:
    """A drum about its z axis with a striped label."""
    skins = [materials.plain("canister", (0.60, 0.58, 0.52)), materials.plain("label", (0.55, 0.12, 0.05))]
    skins.append(materials.plain("label blue", (0.07, 0.20, 0.48)))
    half = 0.5 * length
    profile = [
        (0.0, -half),
        (0.6 * radius, -half),
        (radius, -half),
        (radius, -0.6 * half),
        (radius, 0.6 * half),
        (radius, half),
    ]
    profile += [(0.6 * radius, half), (0.0, half)]

    def material_at(row: int, k: int) -> int:
        if row == 3:
            return (1, 0, 2, 2, 0, 1, 0, 0)[k // 6]
        return 2 * (k // 24) if row in (0, 6) else 0

    ob = shapes.lathe(name, profile, skins, material_at)
    ob.data.polygons.foreach_set("use_smooth", [False] * len(ob.data.polygons))
    return ob


def _tray(name: str) -> bpy.types.Object:
    """A tray with a print in it."""
    shell = materials.plain("tray", (0.62, 0.60, 0.54))
    root = shapes.box(name, (0.56, 0.42, 0.03), [shell], center=(0, 0, 0.015))
    for center, size in (((0, -0.2, 0.06), (0.56, 0.025, 0.09)), ((0, 0.2, 0.06), (0.56, 0.025, 0.09))):
        shapes.box(f"{name} side", size, [shell], center=center, parent=root)
    for x in (-0.27, 0.27):
        shapes.box(f"{name} end", (0.025, 0.376, 0.09), [shell], center=(x, 0, 0.06), parent=root)
    skin = materials.checks("contact print", ((0.05, 0.05, 0.06), (0.55, 0.55, 0.52)), 0.09)
    shapes.box(f"{name} print", (0.45, 0.32, 0.012), [skin], center=(0, 0, 0.037), parent=root)
    return root


def _strip(name: str) -> bpy.types.Object:
    """A wide strip of film that hangs from its origin, with a weight."""
    root = shapes.empty(name)
    colors = ((0.10, 0.06, 0.05), (0.58, 0.34, 0.12), (0.30, 0.42, 0.20), (0.60, 0.55, 0.42))
    skins = [materials.plain(f"exposure {k}", color) for k, color in enumerate(colors)]
    base = skins[0]
    shapes.box(f"{name} film", (0.30, 0.012, 0.86), [base], center=(0, 0, -0.46), parent=root)
    for k in range(5):
        size, center = (0.22, 0.022, 0.125), (0, 0, -0.13 - 0.16 * k)
        shapes.box(f"{name} exposure", size, [skins[1 + k % 3]], center=center, parent=root)
    weight = materials.plain("weight", (0.50, 0.50, 0.52))
    shapes.box(f"{name} weight", (0.34, 0.05, 0.06), [weight], center=(0, 0, -0.91), parent=root)
    return root


def _door(name: str) -> bpy.types.Object:
    """A panelled door that reaches from its hinge at the origin towards -y."""
    wood = materials.speckled("door", (0.34, 0.18, 0.10), (0.48, 0.30, 0.17), 6.0)
    panel, knob = materials.plain("panel", (0.12, 0.30, 0.24)), materials.plain("knob", (0.62, 0.50, 0.14))
    root = shapes.box(name, (0.04, 0.62, 0.6), [wood], center=(-0.03, -0.33, 0.32))
    for z, skin in ((0.19, panel), (0.46, materials.plain("panel pale", (0.58, 0.54, 0.44)))):
        shapes.box(f"{name} panel", (0.055, 0.44, 0.19), [skin], center=(-0.03, -0.33, z), parent=root)
    shapes.box(f"{name} knob", (0.11, 0.05, 0.05), [knob], center=(-0.03, -0.59, 0.32), parent=root)
    return root


def _can(name: str) -> bpy.types.Object:
    """A flat can with a coloured lid."""
    skins = [materials.plain("tin", (0.62, 0.63, 0.64)), materials.plain("lid", (0.62, 0.40, 0.05))]
    skins.append(materials.plain("lid blue", (0.06, 0.14, 0.44)))
    profile = [(0.0, -0.06), (0.2, -0.06), (0.2, 0.06), (0.15, 0.06), (0.0, 0.06)]

    def material_at(row: int, k: int) -> int:
        return (0, 1, 0, 2)[k // 12] if row in (0, 3) else k // 8 % 2 if row == 1 else 1

    return shapes.lathe(name, profile, skins, material_at)


def _trolley(name: str) -> bpy.types.Object:
    """A low trolley with bottles, heading +x."""
    root = shapes.empty(name)
    deck = materials.checks("deck", ((0.50, 0.46, 0.40), (0.24, 0.22, 0.20)), 0.12)
    tyre = materials.plain("castor", (0.06, 0.06, 0.06))
    shapes.box(f"{name} deck", (0.52, 0.36, 0.05), [deck], center=(0, 0, 0.125), parent=root)
    for x in (-0.2, 0.2):
        for y in (-0.13, 0.13):
            shapes.box(f"{name} castor", (0.09, 0.04, 0.09), [tyre], center=(x, y, 0.05), bevel=0.02, parent=root)
    colors = ((0.42, 0.16, 0.04), (0.10, 0.36, 0.16), (0.60, 0.58, 0.52))
    for k, color in enumerate(colors):
        profile = [(0.0, 0.15), (0.085, 0.15), (0.085, 0.34), (0.035, 0.40), (0.035, 0.45), (0.0, 0.45)]
        skins = [materials.plain(f"bottle {k}", color), materials.plain(f"bottle label {k}", colors[k - 1])]
        bottle = shapes.lathe(
            f"{name} bottle", profile, skins, lambda row, k: int(row == 1 and k < 14), segments=32, parent=root
        )
        bottle.location = (-0.15 + 0.17 * k, 0.07 * (-1) ** k, 0)
    return root


def _tank(name: str) -> bpy.types.Object:
    """A tank with a ribbed lid."""
    skins = [materials.plain("tank", (0.09, 0.09, 0.10)), materials.plain("tank band", (0.55, 0.52, 0.46))]
    profile = [
        (0.0, 0.0),
        (0.16, 0.0),
        (0.16, 0.12),
        (0.16, 0.2),
        (0.16, 0.3),
        (0.18, 0.31),
        (0.18, 0.37),
        (0.07, 0.40),
        (0.06, 0.46),
    ]
    return shapes.lathe(name, [*profile, (0.0, 0.46)], skins, lambda row, k: int(row == 2 or (row == 5 and k // 3 % 2)))

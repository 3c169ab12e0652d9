"""Factory: eleven objects on two belts, under a crane, on the floor and at the machines."""

from __future__ import annotations

import math

import bpy
from building import materials, motion, shapes, stage
from building.motion import Actor
from mathutils import Quaternion

from . import room

BELT_TOP, HIGH_BELT_TOP = 0.56, 0.95
GAP = 0.004
"""Gap between an object and its support, so that no two surfaces coincide."""


def build() -> list[Actor]:
    """Build the scene into the open file.

    Returns:
        Its objects, animated, in the order of their ids.
    """
    _room()
    low, high = BELT_TOP + GAP, HIGH_BELT_TOP + GAP
    facing = Quaternion((1, 0, 0), 0.5 * math.pi)
    along = Quaternion((0, 0, 1), math.radians(6.0)) @ facing
    gear = motion.spin((1.25, 1.62, 1.75), (0, -1, 0), 100.0, rate_deg=80.0, tilt=facing)
    pinion = motion.spin((0.55, 1.62, 1.75), (0, 1, 0), 200.0, rate_deg=160.0, tilt=facing)
    actors = [
        Actor(_crate("red crate", 0.36, (0.55, 0.10, 0.06)), motion.glide((-1.35, 0.6, low), (0.95, 0, 0))),
        Actor(
            _crate("blue crate", 0.32, (0.06, 0.18, 0.48)),
            motion.glide((-0.45, 0.6, low), (1.5, 0, 0), (-0.5, 0, 0), start_deg=20.0),
        ),
        Actor(
            _drum("drum", 0.18, 0.42),
            motion.glide((1.1, 1.25, high + 0.21), (-0.7, 0, 0), (-1.1, 0, 0), speed_deg=25.0),
        ),
        Actor(_arm("robot arm"), motion.spin((-0.95, -0.4, 0.46), (0, 0, 1), 75.0, rate_deg=35.0, start_deg=-140.0)),
        Actor(_load("crane load"), motion.glide((-0.8, 1.25, 2.0), (0.75, 0, -0.15), (0.35, 0, -0.2))),
        Actor(_cogwheel("gear", 0.40, 12, (0.60, 0.42, 0.08)), gear),
        Actor(_cogwheel("pinion", 0.23, 7, (0.10, 0.36, 0.34)), pinion),
        Actor(_drum("barrel", 0.19, 0.46), motion.roll((-0.35, -1.05, GAP + 0.19), 6.0, 0.7, 0.5, 0.19, tilt=along)),
        Actor(_cart("cart"), motion.drive((0.55, -0.9, GAP), 0.85, 15.0, 58.0, 20.0)),
        Actor(_ram("press ram"), motion.oscillate((1.45, 0.6, 1.38), (0, 0, 1), 0.22, 1.7, 60.0)),
        Actor(_toolbox("toolbox")),
    ]
    actors[-1].ob.location = (-0.1, -0.25, GAP)
    motion.perform(actors)
    return actors


def _room() -> None:
    room.new()
    floor = materials.speckled("concrete", (0.30, 0.29, 0.28), (0.44, 0.43, 0.41), 2.6, sharp=0.6)
    wall = materials.planks("bricks", ((0.42, 0.19, 0.13), (0.34, 0.14, 0.10), (0.52, 0.48, 0.44)), 0.17)
    room.build(floor, wall, materials.plain("ceiling", (0.45, 0.46, 0.48)))
    steel = materials.speckled("steel", (0.30, 0.33, 0.36), (0.42, 0.45, 0.48), 5.0, sharp=0.5)
    belt = materials.planks("belt", ((0.09, 0.09, 0.10), (0.13, 0.13, 0.14), (0.30, 0.28, 0.10)), 0.24)
    yellow, black = (
        materials.plain("hazard yellow", (0.70, 0.48, 0.03)),
        materials.plain("hazard black", (0.04, 0.04, 0.04)),
    )
    room.skirting(steel)
    for k in range(16):
        stripe = shapes.box("Hazard stripe", (0.24, 0.12, 0.004), [yellow if k % 2 else black])
        stripe.location = (-1.8 + 0.24 * k, -1.55, 0.003)
    for name, y, top, width in (("Belt", 0.6, BELT_TOP, 0.56), ("High belt", 1.25, HIGH_BELT_TOP, 0.5)):
        shapes.box(f"{name} frame", (3.5, width + 0.06, 0.14), [steel], center=(0, y, top - 0.1))
        shapes.box(name, (3.5, width, 0.03), [belt]).location = (0, y, top - 0.015)
        room.legs(name, (-1.6, 0.0, 1.6), (y - 0.2, y + 0.2), top - 0.17, 0.09, materials=[steel])
    shapes.rod("Arm base", 0.26, 0.0, 0.45, [steel, yellow], segments=32).location = (-0.95, -0.4, 0)
    shapes.box("Crane rail", (4.6, 0.16, 0.2), [yellow], center=(0, 1.25, 3.1))
    panel = shapes.box("Gear plate", (1.9, 0.06, 1.1), [steel])
    panel.location = (1.0, 1.85, 1.75)
    room.legs("Gear plate", (0.15, 1.85), (1.85, 1.851), 1.2, 0.08, materials=[steel])
    for x in (1.13, 1.77):
        shapes.box("Press post", (0.09, 0.12, 2.0), [steel], center=(x, 0.98, 1.0))
    shapes.box("Press beam", (0.73, 0.5, 0.16), [yellow], center=(1.45, 0.8, 2.08))
    stage.area_light("Hall light left", (-1.6, -1.4, 3.25), (-0.3, 0.2, 0.5), (2.2, 0.35), 95.0, (0.92, 0.97, 1.0))
    stage.area_light("Hall light right", (1.6, -0.6, 3.25), (0.3, 0.2, 0.5), (2.2, 0.35), 95.0, (1.0, 0.95, 0.85))


def _crate(name: str, edge: float, color: materials.Color) -> bpy.types.Object:
    """A wooden crate with coloured boards on its sides and a label on one."""
    wood = materials.speckled(f"{name} wood", (0.44, 0.28, 0.14), (0.56, 0.38, 0.20), 6.0)
    paint, label = materials.plain(f"{name} paint", color), materials.plain(f"{name} label", (0.74, 0.72, 0.66))
    half = 0.5 * edge
    root = shapes.box(name, (edge, edge, edge), [wood], center=(0, 0, half), bevel=0.02)
    for sign in (-1, 1):
        for z in (0.2 * edge, 0.8 * edge):
            shapes.box(
                f"{name} board", (0.96 * edge, 0.02, 0.16 * edge), [paint], center=(0, sign * half, z), parent=root
            )
        shapes.box(
            f"{name} board", (0.02, 0.8 * edge, 0.25 * edge), [paint], center=(sign * half, 0, half), parent=root
        )
    shapes.box(f"{name} lid", (0.5 * edge, 0.7 * edge, 0.02), [paint], center=(0.12 * edge, 0, edge), parent=root)
    shapes.box(
        f"{name} label", (0.3 * edge, 0.024, 0.24 * edge), [label], center=(-0.15 * edge, -half, half), parent=root
    )
    return root


def _drum(name: str, radius: float, length: float) -> bpy.types.Object:
    """A steel drum about its z axis with two hoops and a sector painted."""
    skins = [materials.plain(f"{name} green", (0.08, 0.34, 0.20)), materials.plain(f"{name} hoop", (0.62, 0.60, 0.54))]
    skins.append(materials.plain(f"{name} orange", (0.72, 0.28, 0.04)))
    half, dent = 0.5 * length, 0.94 * radius
    profile = [
        (0.0, -half),
        (0.5 * radius, -half),
        (radius, -half),
        (dent, -0.9 * half),
        (dent, -0.4 * half),
        (radius, -0.35 * half),
    ]
    profile += [
        (radius, -0.25 * half),
        (dent, -0.2 * half),
        (dent, 0.2 * half),
        (radius, 0.25 * half),
        (radius, 0.35 * half),
    ]
    profile += [(dent, 0.4 * half), (dent, 0.9 * half), (radius, half), (0.5 * radius, half), (0.0, half)]

    def material_at(row: int, k: int) -> int:
        if row in (1, 13):
            return 2 if k < 14 else 1 if 24 <= k < 30 else 0
        return 1 if row in (5, 9, 0, 14) else 2 if 30 <= k < 42 and row in (3, 7, 11) else 0

    return shapes.lathe(name, profile, skins, material_at)


def _arm(name: str) -> bpy.types.Object:
    """An arm on a turntable at its origin, reaching along +x, with a gripper."""
    orange, grey = materials.plain("arm orange", (0.74, 0.26, 0.03)), materials.plain("arm grey", (0.22, 0.23, 0.25))
    white = materials.plain("arm white", (0.74, 0.73, 0.70))
    root = shapes.rod(name, 0.22, 0.0, 0.10, [grey, orange], segments=32)
    shapes.box(f"{name} column", (0.2, 0.24, 0.62), [orange], center=(0, 0, 0.4), taper=0.75, bevel=0.02, parent=root)
    shapes.box(f"{name} stripe", (0.21, 0.25, 0.08), [white], center=(0, 0, 0.32), parent=root)
    shapes.box(f"{name} boom", (0.72, 0.14, 0.15), [orange], center=(0.3, 0, 0.72), bevel=0.02, parent=root)
    shapes.box(f"{name} band", (0.08, 0.15, 0.16), [white], center=(0.42, 0, 0.72), parent=root)
    shapes.box(f"{name} counterweight", (0.2, 0.22, 0.2), [grey], center=(-0.16, 0, 0.72), bevel=0.02, parent=root)
    shapes.box(f"{name} wrist", (0.1, 0.1, 0.2), [grey], center=(0.6, 0, 0.58), parent=root)
    for y in (-0.08, 0.08):
        shapes.box(f"{name} finger", (0.06, 0.04, 0.17), [white], center=(0.6, y, 0.43), parent=root)
    shapes.box(f"{name} palm", (0.09, 0.22, 0.05), [orange], center=(0.6, 0, 0.51), parent=root)
    return root


def _load(name: str) -> bpy.types.Object:
    """A container about its origin, hung from a hook block by slings."""
    root = shapes.box(
        name, (0.5, 0.34, 0.3), [materials.speckled("container", (0.50, 0.08, 0.10), (0.40, 0.05, 0.07), 5.0)]
    )
    white, iron = materials.plain("container white", (0.72, 0.70, 0.66)), materials.plain("hook", (0.12, 0.12, 0.13))
    for x in (-0.15, 0.02, 0.17):
        shapes.box(f"{name} rib", (0.05, 0.36, 0.27), [white if x < 0 else iron], center=(x, 0, 0), parent=root)
    shapes.box(
        f"{name} hook block",
        (0.14, 0.12, 0.14),
        [materials.plain("hook yellow", (0.70, 0.48, 0.03))],
        center=(0, 0, 0.42),
        parent=root,
    )
    shapes.rod(f"{name} cable", 0.02, 0.15, 0.92, [iron], parent=root)
    return root


def _cogwheel(name: str, radius: float, teeth: int, color: materials.Color) -> bpy.types.Object:
    """A cogwheel about its z axis, with three holes painted on its face."""
    outline = []
    for k in range(teeth):
        for share, r in ((-0.28, 0.84), (-0.16, 1.0), (0.16, 1.0), (0.28, 0.84)):
            angle = math.tau * (k + share) / teeth
            outline.append((radius * r * math.cos(angle), radius * r * math.sin(angle)))
    face, side = materials.plain(f"{name} face", color), materials.plain(f"{name} side", tuple(0.5 * c for c in color))
    root = shapes.prism(name, outline, -0.06, 0.06, [face, side])
    hole, mark = (
        materials.plain(f"{name} hole", (0.05, 0.05, 0.06)),
        materials.plain(f"{name} mark", (0.74, 0.72, 0.68)),
    )
    for k in range(3):
        angle = math.tau * k / 3
        skin = mark if k == 0 else hole
        part = shapes.rod(f"{name} hole", 0.2 * radius, -0.065, 0.065, [skin], segments=24, parent=root)
        part.location = (0.5 * radius * math.cos(angle), 0.5 * radius * math.sin(angle), 0)
    shapes.rod(f"{name} axle", 0.15 * radius, -0.1, 0.1, [mark, hole], segments=24, parent=root)
    return root


def _cart(name: str) -> bpy.types.Object:
    """A fork-lift truck that heads +x."""
    root = shapes.empty(name)
    yellow, black = (
        materials.plain("truck yellow", (0.72, 0.46, 0.03)),
        materials.plain("truck black", (0.05, 0.05, 0.05)),
    )
    red = materials.plain("truck red", (0.55, 0.06, 0.05))
    shapes.box(f"{name} body", (0.42, 0.32, 0.2), [yellow], center=(-0.05, 0, 0.19), bevel=0.03, parent=root)
    shapes.box(f"{name} weight", (0.12, 0.3, 0.16), [black], center=(-0.24, 0, 0.24), bevel=0.02, parent=root)
    shapes.box(f"{name} seat", (0.14, 0.2, 0.1), [red], center=(-0.12, 0, 0.34), bevel=0.02, parent=root)
    for y in (-0.13, 0.13):
        shapes.box(f"{name} mast", (0.04, 0.04, 0.5), [black], center=(0.19, y, 0.32), parent=root)
        shapes.box(f"{name} fork", (0.22, 0.05, 0.025), [black], center=(0.31, y, 0.06), parent=root)
        for x in (-0.18, 0.08):
            wheel = shapes.rod(f"{name} wheel", 0.085, -0.03, 0.03, [black, yellow], segments=24, parent=root)
            wheel.location, wheel.rotation_euler = (x, 1.2 * y, 0.087), (0.5 * math.pi, 0, 0)
    shapes.box(f"{name} roof", (0.3, 0.3, 0.03), [yellow], center=(-0.02, 0, 0.56), parent=root)
    for y in (-0.13, 0.13):
        shapes.box(f"{name} post", (0.03, 0.03, 0.28), [black], center=(-0.15, y, 0.42), parent=root)
    return root


def _ram(name: str) -> bpy.types.Object:
    """The striped head of a press about its origin, on a rod that goes up."""
    steel, blue = materials.plain("ram steel", (0.55, 0.57, 0.60)), materials.plain("ram blue", (0.05, 0.18, 0.50))
    root = shapes.box(name, (0.42, 0.34, 0.14), [blue], bevel=0.015)
    for x in (-0.12, 0.12):
        shapes.box(f"{name} stripe", (0.08, 0.35, 0.145), [steel], center=(x, 0, 0), parent=root)
    shapes.rod(f"{name} rod", 0.06, 0.05, 0.38, [steel], parent=root)
    return root


def _toolbox(name: str) -> bpy.types.Object:
    """A red box of drawers with a handle."""
    red, grey = materials.plain("toolbox red", (0.52, 0.05, 0.04)), materials.plain("toolbox grey", (0.60, 0.60, 0.58))
    root = shapes.box(name, (0.46, 0.26, 0.3), [red], center=(0, 0, 0.15), bevel=0.015)
    for z in (0.07, 0.15, 0.23):
        shapes.box(f"{name} drawer", (0.38, 0.02, 0.02), [grey], center=(0, -0.135, z), parent=root)
    shapes.box(f"{name} handle", (0.26, 0.04, 0.03), [grey], center=(0, 0, 0.36), parent=root)
    for x in (-0.12, 0.12):
        shapes.box(f"{name} bracket", (0.03, 0.04, 0.06), [grey], center=(x, 0, 0.32), parent=root)
    return root

"""Flag and balloon: a waving flag and a breathing balloon change their shape; a car, a block and a vase keep theirs."""

from __future__ import annotations

import math

import bpy
from building import materials, motion, shapes, stage, toys
from building.motion import Actor

from . import room

GAP = 0.004


def build() -> list[Actor]:
    """Build the scene into the open file.

    Returns:
        Its objects, animated, in the order of their ids. The flag and the balloon have no law, because no pose
        describes their motion.
    """
    _room()
    actors = [
        Actor(_flag("flag")),
        Actor(_balloon("balloon", 0.42)),
        Actor(toys.toy_car("toy car"), motion.drive((-0.1, 0.1, GAP), 1.2, 205.0, 62.0, 26.0)),
        Actor(toys.toy_block("wooden block", 0.42), motion.slide((1.42, -0.2, GAP), 190.0, 1.1, 1.2, 15.0, 95.0)),
        Actor(toys.vase("vase")),
    ]
    actors[1].ob.location = (0.85, 0.75, 0.66)
    actors[4].ob.location = (-0.25, 0.35, GAP)
    motion.perform(actors)
    return actors


def _room() -> None:
    room.new()
    floor = materials.planks("boards", ((0.40, 0.33, 0.26), (0.33, 0.26, 0.20), (0.15, 0.11, 0.08)), 0.36)
    wall = materials.speckled("plaster", (0.42, 0.50, 0.58), (0.56, 0.62, 0.66), 1.8, sharp=0.75)
    room.build(floor, wall, materials.plain("ceiling", (0.75, 0.75, 0.75)))
    room.skirting(materials.plain("skirting", (0.30, 0.22, 0.16)))
    room.picture(
        "Chart",
        1.0,
        1.9,
        (1.5, 1.0),
        materials.plain("frame", (0.10, 0.10, 0.12)),
        materials.speckled("chart", (0.10, 0.30, 0.30), (0.72, 0.64, 0.42), 2.0, sharp=0.8),
    )
    steel = materials.plain("pole", (0.45, 0.46, 0.48))
    shapes.rod("Pole", 0.03, 0.0, 2.05, [steel]).location = (-1.1, 0.75, 0)
    shapes.rod("Pole foot", 0.24, 0.0, 0.05, [steel], segments=32).location = (-1.1, 0.75, 0)
    stand = materials.checks("stand", ((0.20, 0.20, 0.22), (0.62, 0.60, 0.56)), 0.12)
    shapes.rod("Balloon stand", 0.2, 0.0, 0.12, [stand], segments=32).location = (0.85, 0.75, 0)
    stage.area_light("Ceiling light", (0.2, -0.8, 3.25), (0.0, 0.0, 0.0), (2.0, 1.4), 110.0, (1.0, 0.95, 0.88))
    stage.area_light("Window", (3.4, -1.0, 1.9), (-0.5, 0.2, 0.7), (1.6, 1.4), 55.0, (0.82, 0.90, 1.0))


def _flag(name: str, width: float = 1.25, height: float = 0.8) -> bpy.types.Object:
    """A flag at the pole with waves that travel to its free end, where they are highest.

    The offset a sin(k x - w t), with a growing along x, is the sum of two shapes: a sin(k x) by cos(w t), and
    -a cos(k x) by sin(w t).
    """
    colors = ((0.70, 0.06, 0.05), (0.80, 0.76, 0.66), (0.04, 0.14, 0.50), (0.80, 0.55, 0.04))
    skins = [materials.plain(f"flag {k}", color) for k, color in enumerate(colors)]

    def material_at(i: int, j: int) -> int:
        return 3 if i < 10 and j >= 9 else (i // 5 + 2 * (j // 4)) % 3

    ob = shapes.grid(name, (width, height), (30, 18), skins, material_at, smooth=True)
    ob.location, ob.rotation_euler = (-1.06, 0.75, 1.2), (0.5 * math.pi, 0.0, 0.0)
    ob.shape_key_add(name="flat")
    for label, wave in (("sine", math.sin), ("cosine", lambda angle: -math.cos(angle))):
        key = ob.shape_key_add(name=label)
        for vertex, moved in zip(ob.data.vertices, key.data, strict=True):
            share = vertex.co.x / width
            moved.co = vertex.co.copy()
            moved.co.z += 0.2 * share * wave(1.15 * math.tau * share)
        turn = math.cos if label == "sine" else math.sin
        motion.animate_shape(key, lambda t, turn=turn: turn(math.tau * t / 0.8))
    return ob


def _balloon(name: str, radius: float) -> bpy.types.Object:
    """A ball about its origin that breathes: by a fifth in width, and less in height, a quarter of a period later."""
    patches = materials.speckled("balloon", (0.62, 0.10, 0.30), (0.80, 0.62, 0.20), 3.0, sharp=0.9)
    cap = materials.plain("balloon cap", (0.08, 0.10, 0.30))
    ob = shapes.ball(name, radius, [patches, cap], lambda row, k: int(row < 3 or row > 21))

    def breath(t: float) -> tuple[float, float, float]:
        angle = math.tau * t / 0.9
        across, up = 1.0 + 0.2 * math.sin(angle), 1.0 + 0.12 * math.sin(angle - 0.5 * math.pi)
        return across, across, up

    motion.animate_scale(ob, breath)
    return ob

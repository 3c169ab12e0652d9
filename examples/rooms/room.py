"""A closed room about the stage: floor, walls and ceiling face inwards; the cameras stand inside."""

from __future__ import annotations

import math

import bpy
from building import materials, shapes, stage

LOW = (-3.5, -4.6, 0.0)
HIGH = (3.5, 2.4, 3.3)
"""Corners of the room; the stage is about the origin, and the cameras stand towards -y."""


def new() -> None:
    """Start a scene without lights, with three light bounces, which give most of the indirect light of a room."""
    stage.new((0.0, 0.0, 0.0), 0.0)
    cycles = bpy.context.scene.cycles
    cycles.max_bounces = 3
    cycles.use_light_tree = False  # costs a quarter more than it gains with two or three lights


def build(floor: bpy.types.Material, wall: bpy.types.Material, ceiling: bpy.types.Material) -> None:
    """Build an empty, unlit room. Textures lie in the x and y of a wall, y up."""
    (x0, y0, z0), (x1, y1, z1) = LOW, HIGH
    width, depth, height = x1 - x0, y1 - y0, z1 - z0
    quarter = 0.5 * math.pi
    surfaces = (
        ("Floor", floor, (width, depth), (x0, y0, z0), (0, 0, 0)),
        ("Ceiling", ceiling, (width, depth), (x0, y1, z1), (2 * quarter, 0, 0)),
        ("Wall back", wall, (width, height), (x0, y1, z0), (quarter, 0, 0)),
        ("Wall front", wall, (width, height), (x1, y0, z0), (quarter, 0, 2 * quarter)),
        ("Wall left", wall, (depth, height), (x0, y0, z0), (quarter, 0, quarter)),
        ("Wall right", wall, (depth, height), (x1, y1, z0), (quarter, 0, -quarter)),
    )
    for name, material, size, corner, rotation in surfaces:
        ob = shapes.grid(name, size, (1, 1), [material], lambda i, j: 0)
        ob.location, ob.rotation_euler = corner, rotation


def skirting(material: bpy.types.Material, height: float = 0.16) -> None:
    """A board along the foot of the back and side walls."""
    (x0, y0, _), (x1, y1, _) = LOW, HIGH
    middle = 0.5 * (y0 + y1)
    shapes.box("Skirting back", (x1 - x0, 0.05, height), [material], center=(0.5 * (x0 + x1), y1 - 0.025, 0.5 * height))
    for side, x in (("left", x0 + 0.025), ("right", x1 - 0.025)):
        shapes.box(f"Skirting {side}", (0.05, y1 - y0, height), [material], center=(x, middle, 0.5 * height))


def picture(
    name: str, x: float, z: float, size: tuple[float, float], frame: bpy.types.Material, art: bpy.types.Material
):
    """A framed picture on the back wall, its middle at x and z."""
    y = HIGH[1]
    shapes.box(f"{name} frame", (size[0], 0.06, size[1]), [frame], center=(x, y - 0.03, z))
    inner = (size[0] - 0.14, 0.02, size[1] - 0.14)
    ob = shapes.box(f"{name} art", inner, [art])
    ob.location = (x, y - 0.07, z)


def shelf(name: str, x: float, z: float, wood: bpy.types.Material, width: float = 1.5) -> None:
    """A shelf on the back wall with a row of books, its board at x and z."""
    y = HIGH[1]
    shapes.box(f"{name} shelf", (width, 0.28, 0.05), [wood], center=(x, y - 0.14, z))
    colors = ((0.44, 0.08, 0.06), (0.07, 0.16, 0.34), (0.52, 0.42, 0.22), (0.08, 0.26, 0.14), (0.30, 0.10, 0.26))
    covers = [materials.plain(f"{name} cover {k}", color) for k, color in enumerate(colors)]
    count = 11
    for k in range(count):
        height = 0.30 + 0.05 * (k * k % 5)
        place = (x + width * ((k + 0.5) / count - 0.5), y - 0.13, z + 0.025 + 0.5 * height)
        shapes.box(f"{name} book", (0.8 * width / count, 0.2, height), [covers[3 * k % 5]], center=place)


def legs(name: str, xs: tuple[float, float], ys: tuple[float, float], height: float, thick: float, **options) -> None:
    """Four legs from the floor at the corners of a rectangle; options as for `shapes.box`."""
    for x in xs:
        for y in ys:
            shapes.box(f"{name} leg", (thick, thick, height), center=(x, y, 0.5 * height), **options)

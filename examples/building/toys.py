"""Toys: movable objects of different colours, with their foot at z = 0 unless stated otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy

from . import materials, shapes


def toy_car(name: str) -> bpy.types.Object:
    """A red car with cream stripes, heading +x, its wheels on z = 0. Returns the empty that carries it."""
    root = shapes.empty(name)
    red, cream = materials.plain("car red", (0.62, 0.035, 0.03)), materials.plain("car cream", (0.78, 0.70, 0.48))
    glass, tyre = materials.plain("car glass", (0.10, 0.22, 0.34)), materials.plain("tyre", (0.03, 0.03, 0.035))
    shapes.box(f"{name} body", (0.78, 0.40, 0.17), [red], center=(0, 0, 0.175), bevel=0.04, parent=root)
    shapes.box(
        f"{name} cabin", (0.40, 0.34, 0.18), [glass], center=(-0.06, 0, 0.335), taper=0.72, bevel=0.02, parent=root
    )
    shapes.box(f"{name} roof", (0.30, 0.26, 0.03), [red], center=(-0.06, 0, 0.43), bevel=0.012, parent=root)
    shapes.box(f"{name} stripe", (0.80, 0.11, 0.175), [cream], center=(0, 0, 0.18), bevel=0.03, parent=root)
    shapes.box(f"{name} bumper", (0.06, 0.36, 0.06), [cream], center=(0.40, 0, 0.12), bevel=0.015, parent=root)
    for x in (-0.24, 0.25):
        for y in (-0.2, 0.2):
            profile = [(0.0, -0.04), (0.055, -0.04), (0.056, -0.041), (0.105, -0.04), (0.115, 0.0)]
            profile += [(0.105, 0.04), (0.056, 0.041), (0.055, 0.04), (0.0, 0.04)]
            wheel = shapes.lathe(
                f"{name} wheel", profile, [tyre, cream], lambda row, k: int(row in (0, 7)), parent=root
            )
            wheel.location, wheel.rotation_euler = (x, y, 0.115), (0.5 * math.pi, 0, 0)
    return root


def globe(name: str, radius: float) -> bpy.types.Object:
    """A blue globe with green land and pale poles."""
    sea_and_land = materials.speckled(
        "globe", (0.03, 0.17, 0.50), (0.20, 0.46, 0.07), 1.55 / radius * 0.4, sharp=0.93, middle=0.52
    )
    ice = materials.plain("globe ice", (0.80, 0.84, 0.86))
    return shapes.ball(name, radius, [sea_and_land, ice], lambda row, k: int(row < 3 or row > 20))


def beach_ball(name: str, radius: float) -> bpy.types.Object:
    """A ball of six coloured sectors with white caps."""
    colors = [(0.72, 0.05, 0.04), (0.80, 0.78, 0.72), (0.04, 0.16, 0.60), (0.80, 0.52, 0.03), (0.80, 0.78, 0.72)]
    colors += [(0.06, 0.42, 0.14), (0.80, 0.78, 0.72)]
    skins = [materials.plain(f"ball {k}", color) for k, color in enumerate(colors)]
    return shapes.ball(name, radius, skins, lambda row, k: 6 if row < 2 or row > 21 else k // 8)


def toy_block(name: str, edge: float) -> bpy.types.Object:
    """A wooden block with a square of a different colour on each face. Returns the parent of the squares."""
    wood = materials.speckled("block wood", (0.50, 0.30, 0.13), (0.62, 0.41, 0.20), 6.0)
    ob = shapes.box(name, (edge, edge, edge), [wood], center=(0, 0, 0.5 * edge), bevel=0.03)
    colors = ((0.70, 0.06, 0.08), (0.06, 0.24, 0.62), (0.82, 0.55, 0.04), (0.10, 0.45, 0.20), (0.45, 0.10, 0.50))
    sides = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 1))
    for number, (side, color) in enumerate(zip(sides, colors, strict=True)):
        size = [0.02 if axis else 0.62 * edge for axis in side]
        center = [0.5 * edge * axis for axis in side]
        center[2] += 0.5 * edge
        shapes.box(
            f"{name} face {number}", size, [materials.plain(f"block face {number}", color)], center=center, parent=ob
        )
    return ob


def vase(name: str) -> bpy.types.Object:
    """A vase with bands and checks, its foot on z = 0."""
    profile = [
        (0.0, 0.0),
        (0.17, 0.0),
        (0.19, 0.03),
        (0.25, 0.14),
        (0.29, 0.25),
        (0.31, 0.36),
        (0.29, 0.47),
        (0.24, 0.57),
    ]
    profile += [
        (0.18, 0.66),
        (0.14, 0.73),
        (0.13, 0.80),
        (0.15, 0.86),
        (0.19, 0.90),
        (0.17, 0.90),
        (0.12, 0.80),
        (0, 0.78),
    ]
    skins = [
        materials.plain("vase teal", (0.02, 0.28, 0.30)),
        materials.plain("vase white", (0.75, 0.72, 0.66)),
        materials.plain("vase rust", (0.50, 0.15, 0.05)),
    ]

    def material_at(row: int, k: int) -> int:
        if 4 <= row <= 6:
            return (row + k // 4) % 2
        return 2 if row in (3, 7) else 1 if row in (9, 10) else 0

    return shapes.lathe(name, profile, skins, material_at)


def crate(name: str, size: Sequence[float]) -> bpy.types.Object:
    """A box about its origin, with speckles of a different colour on each face."""
    colors = ((0.70, 0.06, 0.08), (0.06, 0.24, 0.62), (0.82, 0.55, 0.04), (0.10, 0.45, 0.20), (0.45, 0.10, 0.50))
    pairs = [(color, [0.35 * part + 0.35 for part in color]) for color in (*colors, (0.78, 0.74, 0.66))]
    skins = [
        materials.speckled(f"{name} face {k}", low, high, 3.0 / max(size), sharp=0.85)
        for k, (low, high) in enumerate(pairs)
    ]
    return shapes.box(name, size, skins)

"""Shapes: objects made from vertices and faces, with a material for each face."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import bpy


def mesh_object(
    name: str,
    vertices: Iterable[Sequence[float]],
    faces: Sequence[Sequence[int]],
    materials: Sequence[bpy.types.Material],
    material_of_face: Sequence[int] | None = None,
    *,
    smooth: bool = False,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """Make an object in the scene from vertices and faces."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(vertex) for vertex in vertices], [], [tuple(face) for face in faces])
    for material in materials:
        mesh.materials.append(material)
    if material_of_face is not None:
        mesh.polygons.foreach_set("material_index", list(material_of_face))
    mesh.polygons.foreach_set("use_smooth", [smooth] * len(faces))
    mesh.update()
    ob = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(ob)
    ob.parent = parent
    return ob


def lathe(
    name: str,
    profile: Sequence[tuple[float, float]],
    materials: Sequence[bpy.types.Material],
    material_at: Callable[[int, int], int],
    *,
    segments: int = 48,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """Turn a profile about the z axis.

    Args:
        name: Name of the object.
        profile: Radius and height of each ring, from the bottom up; a radius of 0 closes an end.
        materials: Materials of the object.
        material_at: Index of the material of the face at a row and a segment.
        segments: Faces around.
        parent: Parent of the object.
    """
    turns = [math.tau * k / segments for k in range(segments)]
    vertices = [(r * math.cos(a), r * math.sin(a), z) for r, z in profile for a in turns]
    faces, indices = [], []
    for row in range(len(profile) - 1):
        for k in range(segments):
            near, far = row * segments + k, row * segments + (k + 1) % segments
            faces.append((near, far, far + segments, near + segments))
            indices.append(material_at(row, k))
    return mesh_object(name, vertices, faces, materials, indices, smooth=True, parent=parent)


def ball(
    name: str,
    radius: float,
    materials: Sequence[bpy.types.Material],
    material_at: Callable[[int, int], int],
    *,
    rings: int = 24,
    segments: int = 48,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A sphere about its origin; rows count from the south pole."""
    profile = [
        (radius * math.sin(math.pi * k / rings), -radius * math.cos(math.pi * k / rings)) for k in range(rings + 1)
    ]
    return lathe(name, profile, materials, material_at, segments=segments, parent=parent)


def box(
    name: str,
    size: Sequence[float],
    materials: Sequence[bpy.types.Material],
    *,
    center: Sequence[float] = (0, 0, 0),
    taper: float = 1.0,
    bevel: float = 0.0,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A box with edges along the axes; with six materials each face (-x +x -y +y -z +z) has its own.

    Args:
        name: Name of the object.
        size: Edge lengths.
        materials: One material, or six.
        center: Middle of the box.
        taper: Scale of the top relative to the bottom.
        bevel: Width of rounded edges.
        parent: Parent of the object.
    """
    vertices = []
    for z in (-0.5, 0.5):
        shrink = taper if z > 0 else 1.0
        vertices += [
            (center[0] + x * shrink * size[0], center[1] + y * shrink * size[1], center[2] + z * size[2])
            for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
        ]
    faces = [(0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7)]
    indices = range(6) if len(materials) == 6 else [0] * 6
    ob = mesh_object(name, vertices, faces, materials, list(indices), parent=parent)
    if bevel > 0:
        modifier = ob.modifiers.new("Bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 3
    return ob


def rod(
    name: str,
    radius: float,
    low: float,
    high: float,
    materials: Sequence[bpy.types.Material],
    *,
    segments: int = 16,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A closed cylinder about the z axis; with two materials its sides alternate, eight times around."""
    profile = [(0.0, low), (radius, low), (radius, high), (0.0, high)]
    per_side = max(segments // 8, 1)

    def material_at(row: int, k: int) -> int:
        return (k // per_side) % len(materials) if row == 1 else 0

    ob = lathe(name, profile, materials, material_at, segments=segments, parent=parent)
    ob.data.polygons.foreach_set("use_smooth", [False] * len(ob.data.polygons))
    return ob


def grid(
    name: str,
    size: Sequence[float],
    counts: Sequence[int],
    materials: Sequence[bpy.types.Material],
    material_at: Callable[[int, int], int],
    *,
    smooth: bool = False,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A flat rectangle from the origin along +x and +y, made of cells.

    Args:
        name: Name of the object.
        size: Edge lengths along x and y.
        counts: Cells along x and y.
        materials: Materials of the object.
        material_at: Index of the material of the cell at a column and a row.
        smooth: Shade it as a curved surface.
        parent: Parent of the object.
    """
    columns, rows = counts
    vertices = [(size[0] * i / columns, size[1] * j / rows, 0.0) for j in range(rows + 1) for i in range(columns + 1)]
    faces, indices = [], []
    for j in range(rows):
        for i in range(columns):
            corner = j * (columns + 1) + i
            faces.append((corner, corner + 1, corner + columns + 2, corner + columns + 1))
            indices.append(material_at(i, j))
    return mesh_object(name, vertices, faces, materials, indices, smooth=smooth, parent=parent)


def prism(
    name: str,
    outline: Sequence[tuple[float, float]],
    low: float,
    high: float,
    materials: Sequence[bpy.types.Material],
    *,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """An outline in x and y, counter-clockwise, raised along z; a second material is for its sides."""
    count = len(outline)
    vertices = [(x, y, z) for z in (low, high) for x, y in outline]
    faces: list[Sequence[int]] = [tuple(reversed(range(count))), tuple(range(count, 2 * count))]
    faces += [(k, (k + 1) % count, (k + 1) % count + count, k + count) for k in range(count)]
    sides = min(1, len(materials) - 1)
    return mesh_object(name, vertices, faces, materials, [0, 0] + [sides] * count, parent=parent)


def empty(name: str) -> bpy.types.Object:
    """A handle for parts that move as one."""
    ob = bpy.data.objects.new(name, None)
    ob.empty_display_size = 0.3
    bpy.context.scene.collection.objects.link(ob)
    return ob

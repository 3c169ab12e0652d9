"""Convex hulls of point clouds as meshes."""

import bmesh
import bpy
import numpy as np

from ...r5dgs_core.shapes import convex_hull
from . import evaluated_points, loaded_scenes, point_clouds


def corners(cloud: bpy.types.Object, *, stored: bool = True) -> np.ndarray:
    """Vertices of the hull of a point cloud, in its own frame. [V, 3]

    Args:
        cloud: The point cloud.
        stored: True to take the hull of the scene file if it has one; otherwise it is computed from the points.
    """
    found = np.reshape(cloud.get(loaded_scenes.HULL, ()), (-1, 3)) if stored else np.zeros((0, 3))
    if len(found):
        return found
    parts = {name: point_clouds.attribute(cloud.data, *kind[:2]) for name, kind in evaluated_points.PARTS.items()}
    if any(part is None for part in parts.values()):
        return np.zeros((0, 3))
    values = {name: point_clouds.read(part, *evaluated_points.PARTS[name][2:]) for name, part in parts.items()}
    return convex_hull.vertices(values["means"], values["quats"], values["scales"], values["base"][:, 3])


def new_mesh(name: str, points: np.ndarray) -> bpy.types.Mesh | None:
    """Create the convex hull of points [V, 3] as a mesh of triangles; None if they have no volume."""
    built = bmesh.new()
    try:
        for point in points:
            built.verts.new(point)
        if len(points) >= 4:
            bmesh.ops.convex_hull(built, input=built.verts)
            loose = [vertex for vertex in built.verts if not vertex.link_faces]
            bmesh.ops.delete(built, geom=loose, context="VERTS")
        if not built.faces:
            return None
        mesh = bpy.data.meshes.new(name)
        built.to_mesh(mesh)
        return mesh
    finally:
        built.free()

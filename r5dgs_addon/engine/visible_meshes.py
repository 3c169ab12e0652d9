"""Meshes that hide Gaussians: the surfaces of a Blender scene that another engine renders into the same picture."""

import bpy
import numpy as np

from ...r5dgs_core.protocol.meshes import Meshes

SURFACES = ("MESH", "CURVE", "SURFACE", "META", "FONT")


def of(depsgraph: bpy.types.Depsgraph) -> Meshes:
    """Surfaces that cameras see, in Blender's world, with modifiers and instances; parts of loaded scenes excluded."""
    vertices, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int32)], 0
    for instance in depsgraph.object_instances:
        if not _hides(instance, depsgraph):
            continue
        corners, faces = _triangles(instance.object)
        matrix = np.array(instance.matrix_world, np.float64)
        vertices.append(corners @ matrix[:3, :3].T + matrix[:3, 3])
        triangles.append(faces + np.int32(count))
        count += len(corners)
    return Meshes(np.concatenate(vertices).astype(np.float32), np.concatenate(triangles).astype(np.int32))


def names(scene: bpy.types.Scene) -> list[str]:
    """Names of the objects of a Blender scene that can hide Gaussians."""
    found = (obj for obj in scene.collection.all_objects if obj.type in SURFACES and not obj.hide_render)
    return [obj.name for obj in found if obj.r5dgs.role == "NONE"]


def corners(evaluated: bpy.types.Object) -> np.ndarray:
    """Vertices of an evaluated surface, in its own frame. [V, 3]"""
    return _triangles(evaluated)[0].astype(np.float64)


def _hides(instance: bpy.types.DepsgraphObjectInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    obj = instance.object.original
    maker = instance.parent.original if instance.is_instance and instance.parent is not None else obj
    if obj.type not in SURFACES or not instance.show_self or obj.r5dgs.role != "NONE" or maker.r5dgs.role != "NONE":
        return False
    if maker.indirect_only_get(view_layer=depsgraph.view_layer):
        return False
    return all(one.evaluated_get(depsgraph).visible_camera for one in (obj, maker))


def _triangles(evaluated: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Corners and triangles of an evaluated object, in its own frame. [V, 3], [T, 3]"""
    mesh = evaluated.to_mesh()
    if mesh is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    try:
        mesh.calc_loop_triangles()
        corners, faces = np.empty(3 * len(mesh.vertices), np.float32), np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.vertices.foreach_get("co", corners)
        mesh.loop_triangles.foreach_get("vertices", faces)
    finally:
        evaluated.to_mesh_clear()
    return corners.reshape(-1, 3), faces.reshape(-1, 3)

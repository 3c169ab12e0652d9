"""Loaded scenes of a .blend: collections, presence in a Blender scene, members and origin."""

import contextlib
from collections.abc import Iterator

import bpy
import numpy as np

ORIGIN = "r5dgs_origin"  # custom property of the root, because Blender's built-in vectors are float32
SKY = "r5dgs_sky"  # custom property of the collection: coefficients of the sky
# Custom property of the collection: pose of the best captured camera (OpenGL axes), distance to the objects, size of
# the picture at distance 1.
VIEW = "r5dgs_view"
HULL = "r5dgs_hull"  # custom property of the clouds of bodies: vertices of their hull, empty if the file has none
LIGHT = "r5dgs_light"  # custom property of the collection: direction of the light that shading depends on


def scene_collections() -> list[bpy.types.Collection]:
    """Return all collections that hold a loaded R5DGS scene."""
    return [collection for collection in bpy.data.collections if collection.r5dgs.is_scene]


def shown(scene: bpy.types.Scene) -> dict[bpy.types.Collection, list[bpy.types.Object]]:
    """Loaded scenes in a Blender scene, and the objects that instance them.

    Returns:
        Instancers by collection. Scenes whose own objects are in the Blender scene come first, with an empty list.
    """
    inside = set(scene.collection.children_recursive)
    loaded = scene_collections()
    result: dict[bpy.types.Collection, list[bpy.types.Object]] = {one: [] for one in loaded if one in inside}
    outside = set(loaded) - inside
    if outside:  # otherwise skip the loop over objects
        known: dict[bpy.types.Collection, set[bpy.types.Collection]] = {}  # panels call this at each redraw
        for obj in scene.collection.all_objects:
            own = obj.instance_collection if obj.instance_type == "COLLECTION" else None
            if own is None:
                continue
            if own not in known:
                known[own] = _instanced(obj) & outside
            for collection in known[own]:
                result.setdefault(collection, []).append(obj)
    return result


def _instanced(obj: bpy.types.Object) -> set[bpy.types.Collection]:
    """Collections that an object instances, including nested instances."""
    found: set[bpy.types.Collection] = set()
    waiting = [obj]
    while waiting:
        instancer = waiting.pop()
        collection = instancer.instance_collection if instancer.instance_type == "COLLECTION" else None
        if collection is not None and collection not in found:
            found.update((collection, *collection.children_recursive))
            waiting.extend(collection.all_objects)
    return found


def active_collection(context: bpy.types.Context) -> bpy.types.Collection | None:
    """Loaded scene that the active object belongs to or instances, otherwise the first one, or None."""
    candidates = shown(context.scene)
    active = context.view_layer.objects.active
    if active is not None:
        for collection, instancers in candidates.items():
            if active in instancers or collection.all_objects.get(active.name) == active:
                return collection
    return next(iter(candidates), None)


def is_own(collection: bpy.types.Collection) -> bool:
    """True if a loaded scene is local to the open .blend, neither linked nor a library override."""
    return collection.library is None and collection.override_library is None


def members(collection: bpy.types.Collection, *roles: str) -> list[bpy.types.Object]:
    """Objects of a loaded scene with one of the given roles."""
    return [obj for obj in collection.all_objects if obj.r5dgs.role in roles]


def origin(collection: bpy.types.Collection | None) -> np.ndarray:
    """Origin of a loaded scene's positions in the data set's world. [3] float64

    Zero if the scene is near the world's origin, missing, or has lost its root or property.
    """
    root = None if collection is None else collection.r5dgs.root
    try:
        found = np.array(root[ORIGIN], np.float64) if root is not None and ORIGIN in root else np.zeros(3)
    except (TypeError, ValueError):
        found = np.zeros(0)
    return found if found.shape == (3,) and np.isfinite(found).all() else np.zeros(3)


def light(collection: bpy.types.Collection) -> np.ndarray | None:
    """Direction of a loaded scene's light in its own world, or None without shading. [3] float64"""
    found = np.array(collection.get(LIGHT, ()), np.float64)
    return found if found.shape == (3,) and np.isfinite(found).all() else None


def origin_text(origin: np.ndarray) -> str:
    """Format an origin for messages and labels, such as "(5000002, -3500000, 1500002)"."""
    return f"({', '.join(f'{value:.15g}' for value in origin)})"


@contextlib.contextmanager
def nothing_left_after_error() -> Iterator[None]:
    """Remove all data-blocks created in the ``with`` block if it raises."""
    kinds = ("collections", "objects", "cameras", "meshes", "pointclouds", "actions", "materials", "node_groups")
    before = {kind: {data.session_uid for data in getattr(bpy.data, kind)} for kind in kinds}
    try:
        yield
    except BaseException:
        made = [data for kind in kinds for data in getattr(bpy.data, kind) if data.session_uid not in before[kind]]
        bpy.data.batch_remove(made)
        raise

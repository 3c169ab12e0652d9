"""Visible point clouds of the loaded scenes, with their transforms, as evaluated by the depsgraph.

A bind-state point x of a point cloud appears at A x, where A is the object's matrix in Blender's world. The scene's own
world, in which its light direction is fixed, follows its root. A collection instance transforms both.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core.scene.instance import Instance
from ..scene import evaluated_points, loaded_scenes, point_clouds, retiming, timeline

FLAT = 1e-6  # minimum ratio of smallest to largest scale


@dataclass(frozen=True, kw_only=True)
class VisibleCloud(Instance):
    """Visible point cloud, or an instance of one, in Blender's world; residuals are applied if Exact Mode is on.

    Attributes:
        object: Point cloud object, or the instanced one.
        collection: Loaded scene.
        parent: Instancer, or None.
        edit: Edited points, or None if they are those of the scene file.
        seen: True if cameras see it: neither ray visibility nor an indirect-only collection hides it.
    """

    world: np.ndarray
    tint: tuple[float, float, float]
    object: bpy.types.Object
    collection: bpy.types.Collection
    parent: bpy.types.Object | None = None
    edit: evaluated_points.Edit | None = None
    seen: bool = True


def instances(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None, edits: bool = True
) -> tuple[tuple[bpy.types.Collection, ...], tuple[VisibleCloud, ...]]:
    """Loaded scenes in the view layer and their visible point clouds.

    Args:
        depsgraph: Evaluated depsgraph.
        space: 3D view whose local view is respected.
        edits: True to compare the points with the scene file; otherwise point clouds count as unedited.

    Returns:
        Collections of the visible point clouds, or all that are not excluded if none is visible; and the instances.

    Raises:
        ConfigError: A point cloud has lost points and cannot be matched with its scene file.
    """
    homes, scenes = _homes(), _scenes(depsgraph)
    seen = [(obj, matrix, parent, homes.get(obj) or _by_root(obj)) for obj, matrix, parent in _clouds(depsgraph, space)]
    seen = [one for one, nothing in zip(seen, flat([one[1] for one in seen]), strict=True) if one[3] and not nothing]
    there = {one[3] for one in seen}
    scenes = [one for one in scenes if one in there or not there]
    scenes += [one for one in dict.fromkeys(one[3] for one in seen) if one not in scenes]
    worlds = {one: world_of(one, depsgraph) for one in scenes}
    frame, found = depsgraph.scene.frame_current_final, []
    for obj, matrix, parent, collection in seen:
        world = worlds[collection]
        if parent is not None:  # the instancer transforms the point cloud and its world alike
            own = np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)
            world = matrix @ np.linalg.solve(own, world)
        tint, number = tuple(obj.r5dgs_look.tint), scenes.index(collection)
        t = None
        if collection.r5dgs_exact.enabled:
            t = timeline.of_collection(collection).time(retiming.source_frame(obj, frame))
        edit = evaluated_points.of(obj, depsgraph, collection.r5dgs.gaussians).edit if edits else None
        count = obj.r5dgs.count if edit is None else len(edit.points.rows)
        t = None if edit is not None and edit.bent else t
        if not count:
            continue
        found.append(
            VisibleCloud(
                obj.r5dgs.start,
                count,
                matrix,
                number,
                world=world,
                tint=tint,
                t=t,
                holdout=is_held_out(obj, parent, depsgraph),
                object=obj,
                collection=collection,
                parent=parent,
                edit=edit,
                seen=_is_seen(obj, parent, depsgraph),
            )
        )
    return tuple(scenes), tuple(found)


def world_of(collection: bpy.types.Collection, depsgraph: bpy.types.Depsgraph | None = None) -> np.ndarray:
    """Transform from a loaded scene's world to Blender's, or identity if its root is missing or flat. [4, 4] float64"""
    root = collection.r5dgs.root
    if root is None:
        return np.eye(4)
    evaluated = root if depsgraph is None else root.evaluated_get(depsgraph)
    matrix = np.array(evaluated.matrix_world, np.float64)
    return np.eye(4) if flat([matrix])[0] else matrix


def flat(matrices: list[np.ndarray]) -> np.ndarray:
    """Mask of transforms that are not finite or singular within single precision; such objects are invisible. [n]"""
    if not matrices:
        return np.zeros(0, bool)
    stacked = np.stack(matrices)
    usable = np.isfinite(stacked).all((1, 2), keepdims=True)
    scales = np.linalg.svd(np.where(usable, stacked, 0)[:, :3, :3], compute_uv=False)
    return scales[:, 2] <= FLAT * scales[:, 0]


def points(found: tuple[VisibleCloud, ...]) -> Callable[[], np.ndarray]:
    """Return a function that computes the bounding box corners of visible point clouds. [P, 3] float64

    It reads every point, so it is called only for parallel projections. Blender's own bounding boxes may be outdated.
    """

    def corners() -> np.ndarray:
        boxes, result = {}, [np.zeros((0, 3))]
        for one in found:
            moved = None if one.edit is None else one.edit.points.means
            key = one.object.data if moved is None or one.edit is None else one.edit.key
            if key not in boxes:
                boxes[key] = _box(_positions(one.object.data) if moved is None else moved)
            result.append(boxes[key] @ one.matrix[:3, :3].T + one.matrix[:3, 3])
        return np.concatenate(result)

    return corners


def _positions(cloud: bpy.types.PointCloud) -> np.ndarray:
    attribute = point_clouds.attribute(cloud, "position", "FLOAT_VECTOR")
    return np.zeros((0, 3), np.float32) if attribute is None else point_clouds.read(attribute, "vector", 3)


def _box(positions: np.ndarray) -> np.ndarray:
    """Corners of the points' bounding box. [8, 3]"""
    if len(positions) == 0:
        return np.zeros((0, 3))
    ends = [(column.min(), column.max()) for column in positions.T]
    return np.array(list(itertools.product(*ends)), np.float64)


def _clouds(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None
) -> Iterator[tuple[bpy.types.Object, np.ndarray, bpy.types.Object | None]]:
    """Visible point clouds: object, matrix in Blender's world, and instancer or None."""
    instancing = False
    for obj in depsgraph.objects:
        instancing |= obj.instance_type == "COLLECTION" and obj.instance_collection is not None
        if obj.original.r5dgs.role == "CLOUD" and obj.type == "POINTCLOUD" and _seen(obj.original, depsgraph, space):
            yield obj.original, np.array(obj.matrix_world, np.float64), None
    if not instancing:  # iterating over instances is slow if ellipsoids are shown
        return
    for instance in depsgraph.object_instances:
        if not instance.is_instance or instance.object.type != "POINTCLOUD":
            continue
        original, parent = instance.object.original, instance.parent.original
        if original.r5dgs.role == "CLOUD" and original != parent and _seen(parent, depsgraph, space):
            yield original, np.array(instance.matrix_world, np.float64), parent


def is_held_out(obj: bpy.types.Object, parent: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if an object or its instancer is a hold-out, by itself or by a collection."""
    own = obj.evaluated_get(depsgraph)  # renders do not write animated values to the original
    return own.is_holdout or (parent or obj).holdout_get(view_layer=depsgraph.view_layer)


def _is_seen(obj: bpy.types.Object, parent: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if cameras see an object or its instance."""
    maker = parent or obj
    direct = not maker.indirect_only_get(view_layer=depsgraph.view_layer) or is_held_out(obj, parent, depsgraph)
    return direct and all(one.evaluated_get(depsgraph).visible_camera for one in (obj, maker))


def _seen(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None) -> bool:
    """True if a viewport shows an object. Its depsgraph ignores local views and collection visibility."""
    return depsgraph.mode == "RENDER" or obj.visible_get(view_layer=depsgraph.view_layer, viewport=space)


def _homes() -> dict[bpy.types.Object, bpy.types.Collection]:
    """Loaded scene that contains each object."""
    return {obj: collection for collection in loaded_scenes.scene_collections() for obj in collection.all_objects}


def _by_root(obj: bpy.types.Object) -> bpy.types.Collection | None:
    """Loaded scene whose root is an ancestor of the object, for objects moved to other collections."""
    while obj.parent is not None:
        obj = obj.parent
        if obj.r5dgs.role == "ROOT":
            return next((c for c in loaded_scenes.scene_collections() if c.r5dgs.root == obj), None)
    return None


def _scenes(depsgraph: bpy.types.Depsgraph) -> list[bpy.types.Collection]:
    """Loaded scenes in the depsgraph's view layer that are not excluded."""
    found, waiting = [], [depsgraph.view_layer.layer_collection]
    while waiting:
        layer = waiting.pop(0)
        if layer.exclude:
            continue
        if layer.collection.r5dgs.is_scene and layer.collection not in found:
            found.append(layer.collection)
        waiting.extend(layer.children)
    return found

"""Which clouds Blender shows, where, and of which loaded scene; the depsgraph decides.

A cloud of a scene is shown at A x for a point x of its bind state, A being its matrix in Blender's world. The scene's
own world, in which its light stands, is turned with its root; an instance of a collection turns both.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ..scene import evaluated_points, loaded_scenes, point_clouds, timeline

FLAT = 1e-6  # smallest scale of a map over its largest


@dataclass(frozen=True)
class Instance:
    """A visible cloud, or an instance of one.

    Attributes:
        scene: Number of its collection among the scenes.
        start: First row in the scene file; of an edited cloud, of what it was loaded with.
        count: Number of points.
        matrix: Bind state to Blender's world. [4, 4]
        world: The scene's world to Blender's. [4, 4]
        tint: Factors on red, green and blue.
        t: Scene time that bends what has residuals, where the scene plays exactly; else None.
        object: The cloud; of an instance, the one that is instanced.
        collection: The loaded scene.
        parent: The object that makes the instance, or None.
        edit: The points, if they are not those of the scene file.
        holdout: True if it cuts a hole into pictures.
        seen: True if cameras see it: neither its ray visibility nor an indirect-only collection hides it from them.
    """

    scene: int
    start: int
    count: int
    matrix: np.ndarray
    world: np.ndarray
    tint: tuple[float, float, float]
    object: bpy.types.Object
    collection: bpy.types.Collection
    parent: bpy.types.Object | None = None
    t: float | None = None
    edit: evaluated_points.Edit | None = None
    holdout: bool = False
    seen: bool = True

    def request(self) -> dict[str, Any]:
        """What the worker reads."""
        entry: dict[str, Any] = {
            "scene": self.scene,
            "matrix": self.matrix.tolist(),
            "world": self.world.tolist(),
        }
        entry |= {"start": self.start, "count": self.count} if self.edit is None else {"points": self.edit.key}
        if self.tint != (1.0, 1.0, 1.0):
            entry["tint"] = list(self.tint)
        if self.t is not None:
            entry["t"] = self.t
        if self.holdout:
            entry["holdout"] = True
        return entry


def instances(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None
) -> tuple[tuple[bpy.types.Collection, ...], tuple[Instance, ...]]:
    """The loaded scenes of a Blender scene that are not excluded, and their visible clouds.

    Args:
        depsgraph: Evaluated.
        space: A 3D view whose local view hides the rest.

    Returns:
        Collections of the clouds, or, where no cloud is visible, all that are not excluded; and the clouds.

    Raises:
        ConfigError: A cloud has lost points, and nothing tells which.
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
        if parent is not None:  # what the instancer does to the cloud, it does to its world
            own = np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)
            world = matrix @ np.linalg.solve(own, world)
        tint, number = tuple(obj.r5dgs_look.tint), scenes.index(collection)
        t = timeline.of_collection(collection).time(frame) if collection.r5dgs_exact.enabled else None
        edit = evaluated_points.of(obj, depsgraph, collection.r5dgs.gaussians).edit
        count = obj.r5dgs.count if edit is None else len(edit.points.rows)
        t = None if edit is not None and edit.bent else t
        if not count:
            continue
        camera = is_held_out(obj, parent, depsgraph), _is_seen(obj, parent, depsgraph)
        start = obj.r5dgs.start
        found.append(Instance(number, start, count, matrix, world, tint, obj, collection, parent, t, edit, *camera))
    return tuple(scenes), tuple(found)


def world_of(collection: bpy.types.Collection, depsgraph: bpy.types.Depsgraph | None = None) -> np.ndarray:
    """Map of a loaded scene's world to Blender's; that of the file where its root is gone or flat. [4, 4] float64"""
    root = collection.r5dgs.root
    if root is None:
        return np.eye(4)
    evaluated = root if depsgraph is None else root.evaluated_get(depsgraph)
    matrix = np.array(evaluated.matrix_world, np.float64)
    return np.eye(4) if flat([matrix])[0] else matrix


def flat(matrices: list[np.ndarray]) -> np.ndarray:
    """Which maps flatten space, as far as single precision tells: what is scaled to nothing is not seen. [n]"""
    if not matrices:
        return np.zeros(0, bool)
    scales = np.linalg.svd(np.stack(matrices)[:, :3, :3], compute_uv=False)
    return scales[:, 2] <= FLAT * scales[:, 0]


def points(found: tuple[Instance, ...]) -> Callable[[], np.ndarray]:
    """A function that gives the corners of boxes around visible clouds, Blender's world. [P, 3] float64

    It looks at every point, for which perspective views have no need. (Blender's own boxes are not up to date.)
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
    """Corners of the box around points. [8, 3]"""
    if len(positions) == 0:
        return np.zeros((0, 3))
    ends = [(column.min(), column.max()) for column in positions.T]
    return np.array(list(itertools.product(*ends)), np.float64)


def _clouds(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None
) -> Iterator[tuple[bpy.types.Object, np.ndarray, bpy.types.Object | None]]:
    """Visible clouds: object, matrix in Blender's world, and what makes an instance of it, or None."""
    instancing = False
    for obj in depsgraph.objects:
        instancing |= obj.instance_type == "COLLECTION" and obj.instance_collection is not None
        if obj.original.r5dgs.role == "CLOUD" and obj.type == "POINTCLOUD" and _seen(obj.original, depsgraph, space):
            yield obj.original, np.array(obj.matrix_world, np.float64), None
    if not instancing:  # going through instances is slow where ellipsoids stand for Gaussians
        return
    for instance in depsgraph.object_instances:
        if not instance.is_instance or instance.object.type != "POINTCLOUD":
            continue
        original, parent = instance.object.original, instance.parent.original
        if original.r5dgs.role == "CLOUD" and original != parent and _seen(parent, depsgraph, space):
            yield original, np.array(instance.matrix_world, np.float64), parent


def is_held_out(obj: bpy.types.Object, parent: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if an object, or the instancer of it, is a hold-out by itself or by a collection."""
    own = obj.evaluated_get(depsgraph)  # a render does not write animated values to the original
    return own.is_holdout or (parent or obj).holdout_get(view_layer=depsgraph.view_layer)


def _is_seen(obj: bpy.types.Object, parent: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if cameras see an object, or an instance of it."""
    maker = parent or obj
    direct = not maker.indirect_only_get(view_layer=depsgraph.view_layer) or is_held_out(obj, parent, depsgraph)
    return direct and all(one.evaluated_get(depsgraph).visible_camera for one in (obj, maker))


def _seen(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None) -> bool:
    """Whether a viewport shows an object: the depsgraph of one knows neither local views nor collections' eyes."""
    return depsgraph.mode == "RENDER" or obj.visible_get(view_layer=depsgraph.view_layer, viewport=space)


def _homes() -> dict[bpy.types.Object, bpy.types.Collection]:
    """The loaded scene that each object lies in."""
    return {obj: collection for collection in loaded_scenes.scene_collections() for obj in collection.all_objects}


def _by_root(obj: bpy.types.Object) -> bpy.types.Collection | None:
    """The loaded scene whose root a cloud hangs from, for one that was moved to another collection."""
    while obj.parent is not None:
        obj = obj.parent
        if obj.r5dgs.role == "ROOT":
            return next((c for c in loaded_scenes.scene_collections() if c.r5dgs.root == obj), None)
    return None


def _scenes(depsgraph: bpy.types.Depsgraph) -> list[bpy.types.Collection]:
    """Loaded scenes in the depsgraph's view layer that are not excluded there."""
    found, waiting = [], [depsgraph.view_layer.layer_collection]
    while waiting:
        layer = waiting.pop(0)
        if layer.exclude:
            continue
        if layer.collection.r5dgs.is_scene and layer.collection not in found:
            found.append(layer.collection)
        waiting.extend(layer.children)
    return found

"""Objects of a capture: grouping of Blender objects, ids, and rigid poses at every captured time."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.motion import rotations
from .overrides import Overrides

CHOICES = ("AUTO", "PASS_INDEX", "COLLECTION", "SELECTED", "ANIMATED")
GEOMETRY = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME"}
DEFORMERS = {"ARMATURE", "CLOTH", "SOFT_BODY", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "WAVE", "OCEAN"}


@dataclass(frozen=True)
class Survey:
    """Transforms and bounding boxes of the scene's objects over time.

    Attributes:
        frames: The T captured frames, increasing.
        matrices: World matrices of every rendered object and its ancestors. [T, 4, 4] each
        corners: World-space bounding box corners of every rendered object. [T, 8, 3] each
        moving: Keys of ``matrices`` whose world matrix changes within the frame range.
        deforming: Rendered objects whose shape may change.
    """

    frames: tuple[float, ...]
    matrices: dict[bpy.types.Object, np.ndarray]
    corners: dict[bpy.types.Object, np.ndarray]
    moving: frozenset[bpy.types.Object]
    deforming: frozenset[bpy.types.Object]

    @property
    def animated(self) -> frozenset[bpy.types.Object]:
        """Rendered objects that move or deform."""
        return (self.moving & self.corners.keys()) | self.deforming


@dataclass(frozen=True)
class CapturedObject:
    """Object of the data set, made of one or more Blender objects.

    Attributes:
        id: Value in the masks, from 1.
        name: Name in ``objects.json``.
        root: Blender object that defines the pose.
        members: Blender objects that carry the id.
    """

    id: int
    name: str
    root: bpy.types.Object
    members: tuple[bpy.types.Object, ...]


def survey(context: bpy.types.Context, frames: tuple[float, ...], overrides: Overrides) -> Survey:
    """Play the scene once and record transforms and bounding boxes. All whole frames are visited, for simulations.

    Args:
        context: Context with the scene and view layer.
        frames: The T captured frames, increasing.
        overrides: Records the changes: rendered objects are also shown in the viewport, or they would not be evaluated.

    Returns:
        The survey. The scene's current frame changes.
    """
    scene = context.scene
    geometry: list[bpy.types.Object] = []
    for collection in _rendered_collections(context.view_layer.layer_collection):
        overrides.set(collection, "hide_viewport", False)
        geometry += [ob for ob in collection.objects if ob.type in GEOMETRY and not _is_hidden(ob)]
    geometry = sorted(set(geometry), key=lambda ob: ob.name_full)
    followed = {ancestor for ob in geometry for ancestor in (ob, *_ancestors(ob))}
    for ob in geometry:
        overrides.set(ob, "hide_viewport", False)
    matrices: dict[bpy.types.Object, list[np.ndarray]] = {ob: [] for ob in followed}
    corners: dict[bpy.types.Object, list[np.ndarray]] = {ob: [] for ob in geometry}
    moving: set[bpy.types.Object] = set()
    first: dict[bpy.types.Object, np.ndarray] = {}
    whole = map(float, range(math.floor(frames[0]), math.floor(frames[-1]) + 1))
    for frame in sorted({*frames, *whole}):
        scene.frame_set(math.floor(frame), subframe=frame - math.floor(frame))
        depsgraph = context.evaluated_depsgraph_get()
        for ob in followed:
            evaluated = ob.evaluated_get(depsgraph)
            matrix = np.array(evaluated.matrix_world, np.float64)
            reference = first.setdefault(ob, matrix)
            if not np.allclose(matrix, reference, rtol=1e-6, atol=1e-6):
                moving.add(ob)
            if frame not in frames:
                continue
            matrices[ob].append(matrix)
            if ob in corners:
                box = np.array([list(corner) for corner in evaluated.bound_box], np.float64)
                corners[ob].append(box @ matrix[:3, :3].T + matrix[:3, 3])
    return Survey(
        frames=frames,
        matrices={ob: np.stack(rows) for ob, rows in matrices.items()},
        corners={ob: np.stack(rows) for ob, rows in corners.items()},
        moving=frozenset(moving),
        deforming=frozenset(ob for ob in geometry if _deforms(ob)),
    )


def choose(layer: bpy.types.ViewLayer, survey: Survey, choice: str, collection: str) -> tuple[CapturedObject, ...]:
    """Group Blender objects into the objects of the data set.

    Objects with a common parent form one object, with two exceptions: the parent also has descendants that belong to no
    object (it is then a handle of the whole scene), or a child moves while the parent is still (they are then not
    rigidly connected). With "PASS_INDEX", equal indices form one object and give its id. Otherwise ids count from 1 in
    the order of names, so that they stay the same between captures.

    Args:
        layer: View layer with the selection.
        survey: Survey of the scene.
        choice: One of `CHOICES`.
        collection: Name of the collection for "COLLECTION"; each of its child collections is one object.

    Returns:
        Objects ordered by id, at least one.

    Raises:
        ConfigError: The collection is missing, or no object matches.
    """
    geometry = set(survey.corners)
    if choice == "AUTO":
        if any(ob.pass_index > 0 for ob in geometry):
            choice = "PASS_INDEX"
        else:
            choice = "ANIMATED" if survey.animated else "SELECTED"
    groups: dict[str, set[bpy.types.Object]] = {}
    if choice == "PASS_INDEX":
        chosen = {ob for ob in geometry if ob.pass_index > 0}
        by_index = defaultdict(set)
        for ob in chosen:
            by_index[ob.pass_index].add(ob)
        roots = _roots(survey, chosen)
        found = [_object(index, None, members, roots) for index, members in sorted(by_index.items())]
        return _with_unique_names(_not_empty(found, choice))
    if choice == "COLLECTION":
        source = bpy.data.collections.get(collection)
        if source is None:
            raise errors.ConfigError(f"capture.object_collection: there is no collection {collection!r} in this file")
        groups = {child.name: members for child in source.children if (members := set(child.all_objects) & geometry)}
        chosen = set(source.objects) & geometry - set().union(*groups.values())
    elif choice == "SELECTED":
        chosen = {ob for ob in geometry if any(_is_selected(part, layer) for part in (ob, *_ancestors(ob)))}
    else:
        chosen = geometry & survey.animated
    roots = _roots(survey, chosen.union(*groups.values()))
    by_root = defaultdict(set)
    for ob in chosen:
        by_root[roots[ob]].add(ob)
    named = [(name, members) for name, members in groups.items()]
    named += [(root.name, members) for root, members in by_root.items()]
    named.sort(key=lambda item: (item[0].casefold(), item[0]))
    found = [_object(index + 1, name, members, roots) for index, (name, members) in enumerate(named)]
    return _with_unique_names(_not_empty(found, choice))


def assign_ids(objects: tuple[CapturedObject, ...], overrides: Overrides) -> None:
    """Set the pass index of every Blender object to its object's id, or 0, until the overrides end."""
    ids = {member: captured.id for captured in objects for member in captured.members}
    for ob in bpy.data.objects:
        overrides.set(ob, "pass_index", ids.get(ob, 0))


def poses(survey: Survey, captured: CapturedObject) -> np.ndarray:
    """Rigid pose of an object at each captured frame: location and nearest rotation of its root. [T, 4, 4]"""
    matrices = survey.matrices[captured.root].copy()
    linear = matrices[:, :3, :3]
    sign = np.where(np.linalg.det(linear) < 0, -1.0, 1.0)[:, None, None]
    matrices[:, :3, :3] = rotations.nearest_rotmats(sign * linear)
    return matrices


def bounds(survey: Survey, objects: tuple[CapturedObject, ...]) -> np.ndarray:
    """Bounding box of all objects over all captured times: lowest and highest corner. [2, 3]"""
    corners = np.concatenate([survey.corners[m].reshape(-1, 3) for o in objects for m in o.members])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _rendered_collections(layer_collection: bpy.types.LayerCollection) -> Iterator[bpy.types.Collection]:
    if layer_collection.exclude or layer_collection.collection.hide_render:
        return
    yield layer_collection.collection
    for child in layer_collection.children:
        yield from _rendered_collections(child)


def _is_hidden(ob: bpy.types.Object) -> bool:
    """True if the object never renders. An object with animation data may become visible."""
    if not ob.hide_render:
        return False
    return ob.animation_data is None or ob.animation_data.action is None


def _deforms(ob: bpy.types.Object) -> bool:
    keys = getattr(ob.data, "shape_keys", None)
    return bool(keys and keys.animation_data) or any(modifier.type in DEFORMERS for modifier in ob.modifiers)


def _ancestors(ob: bpy.types.Object) -> list[bpy.types.Object]:
    """Parents from nearest to farthest."""
    found = []
    while ob.parent is not None:
        ob = ob.parent
        found.append(ob)
    return found


def _is_selected(ob: bpy.types.Object, layer: bpy.types.ViewLayer) -> bool:
    return layer.objects.get(ob.name) == ob and ob.select_get(view_layer=layer)


def _roots(survey: Survey, chosen: set[bpy.types.Object]) -> dict[bpy.types.Object, bpy.types.Object]:
    """Map each chosen object to the highest ancestor that belongs to the same data set object."""
    others = set(survey.corners) - chosen
    outsiders = {ancestor for other in others for ancestor in (other, *_ancestors(other))}
    roots = {}
    for ob in chosen:
        roots[ob] = ob
        for ancestor in _ancestors(ob):
            stands = ob in survey.moving and ancestor not in survey.moving
            if stands or ancestor in outsiders or ancestor.type == "CAMERA":
                break
            roots[ob] = ancestor
    return roots


def _object(
    index: int,
    name: str | None,
    members: set[bpy.types.Object],
    roots: dict[bpy.types.Object, bpy.types.Object],
) -> CapturedObject:
    ordered = sorted(members, key=lambda ob: ob.name_full)
    common = {roots[ob] for ob in ordered}
    root = common.pop() if len(common) == 1 else ordered[0]
    return CapturedObject(index, root.name if name is None else name, root, tuple(ordered))


def _not_empty(found: list[CapturedObject], choice: str) -> list[CapturedObject]:
    if found:
        return found
    remedies = {
        "PASS_INDEX": "give the objects a pass index (Object properties > Relations)",
        "COLLECTION": "put the objects into that collection, and make it render",
        "SELECTED": "animate or select the objects, or give them a pass index (Object properties > Relations)",
        "ANIMATED": "animate the objects in this frame range, or choose them another way",
    }
    raise errors.ConfigError(f"capture.objects: expected an object by {choice}, found none; {remedies[choice]}")


def _with_unique_names(found: list[CapturedObject]) -> tuple[CapturedObject, ...]:
    taken: set[str] = set()
    unique = []
    for captured in found:
        name, number = captured.name, 2
        while name in taken:
            name, number = f"{captured.name} {number}", number + 1
        taken.add(name)
        unique.append(CapturedObject(captured.id, name, captured.root, captured.members))
    return tuple(unique)

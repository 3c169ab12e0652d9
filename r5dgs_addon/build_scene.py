"""Build a scene as Blender objects: a root empty, and per object a collection with anchor empties and point clouds.

Notation: the root carries the world convention W. The anchor of motion group g sits at the group's pivot p and is
animated with the group's pose (R, d). A bind-state point x appears at W T(p + d) R T(-p) x, where T(-p) is the point
cloud's parent inverse. The point cloud therefore stores the coordinates of the scene file unchanged. The anchor of a
part with a parent sits at its joint, under the anchor of the parent, and is animated relative to it.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..r5dgs_core import errors
from ..r5dgs_core.color import srgb
from ..r5dgs_core.playback import group_curves, group_dynamics
from ..r5dgs_core.scene import cameras, spherical_harmonics
from ..r5dgs_core.scene.scene import MotionGroup, Scene
from ..r5dgs_core.scene.splats import to_opacities
from ..r5dgs_core.shapes import object_hulls
from . import compat
from .motion import event_markers, exact_mode, keyframes, physics
from .scene import (
    captured_cameras,
    first_view,
    loaded_scenes,
    object_names,
    point_clouds,
    presence_keys,
    relink,
    timeline,
    viewport_display,
)

SMALLEST = 1e-4  # minimum extent of a scene (units); Blender's F-curves ignore changes below 1.2e-7


@dataclass(frozen=True)
class Options:
    """Options of `build`.

    Attributes:
        world_convention: Key of `cameras.WORLD_TO_BLENDER`, or "" for the one stored in the file.
        frame_zero: Frame of scene time 0.
        t_end: Scene time up to which motion is extrapolated, or None for `predictability.horizon`.
        key_tolerance: Maximum error of the reduced keys, as a fraction of the scene's extent.
        fit_timeline: True to set the frame range, and markers at t_max and at the observed events.
        sh_degree: Highest spherical-harmonics degree stored on the points.
        frame_views: True to look at the scene in all 3D views.
        cameras: True to create the captured cameras.
        display: Key of `viewport_display.ITEMS`.
        play_residuals: True to play the residual motion of single Gaussians.
    """

    world_convention: str = ""
    frame_zero: float = 1.0
    t_end: float | None = None
    key_tolerance: float = keyframes.TOLERANCE
    fit_timeline: bool = True
    sh_degree: int = 3
    frame_views: bool = True
    cameras: bool = True
    display: str = viewport_display.SPLATS
    play_residuals: bool = True


@dataclass(frozen=True)
class Range:
    """Consecutive Gaussians of one object and one motion group."""

    object_id: int
    motion_id: int
    start: int
    count: int


def ranges(scene: Scene) -> list[Range]:
    """Split the scene's Gaussians into ranges of constant object id and motion id."""
    pairs = np.stack([scene.gaussians.object_ids, scene.gaussians.motion_ids], axis=-1).astype(np.int64)
    if len(pairs) == 0:
        return []
    starts = np.concatenate([[0], np.flatnonzero((np.diff(pairs, axis=0) != 0).any(-1)) + 1, [len(pairs)]])
    return [
        Range(int(pairs[a, 0]), int(pairs[a, 1]), int(a), int(b - a))
        for a, b in zip(starts[:-1], starts[1:], strict=True)
    ]


def anchor_ranges(scene: Scene, parts: list[Range]) -> list[Range]:
    """Return one range per anchor, whose object collection holds the anchor.

    Each motion group has one anchor; the pinned group 0 has one per object. The anchor of a body goes to the group's
    own object if that object has Gaussians in the group, otherwise to the object with the most Gaussians in it.
    """
    best: dict[tuple[int, int], Range] = {}
    for part in parts:
        group = scene.groups[part.motion_id]
        own = group.role == "body" and part.object_id == group.object_id
        known = best.get(_anchor_key(part))
        known_own = known is not None and group.role == "body" and known.object_id == group.object_id
        if known is None or (own, part.count) > (known_own, known.count):
            best[_anchor_key(part)] = part
    return list(best.values())


def build(context: bpy.types.Context, scene: Scene, path: Path, options: Options = Options()) -> bpy.types.Collection:
    """Build a scene in the active Blender scene. On error, the file is left unchanged.

    Args:
        context: Context whose scene and view layer receive the objects.
        scene: Scene to build.
        path: Source file of the scene, stored for the preview.
        options: Build options.

    Returns:
        The collection ``R5DGS <name>``.

    Raises:
        SceneFileError: The scene has no Gaussians, or is too small for Blender's F-curves.
        ConfigError: The end of extrapolation is too many frames away.
    """
    _check_size(scene, path)
    times = timeline.Times.of(scene, options.frame_zero, options.t_end)
    timeline.check_end(path.name, times)
    with loaded_scenes.nothing_left_after_error():
        collection = bpy.data.collections.new(object_names.fit(f"R5DGS {scene.name}"))
        context.scene.collection.children.link(collection)
        root = _root(collection, scene, options.world_convention or scene.world_convention)
        _describe(collection, scene, path, root, times)
        anchors = _objects(collection, root, scene, options.sh_degree)
        for cloud in loaded_scenes.members(collection, "CLOUD"):
            presence_keys.write(cloud, scene.groups[cloud.r5dgs.motion_id], times)
        viewport_display.show(collection, options.display)
        first_view.remember(collection, scene)
        if options.cameras:
            captured_cameras.build(context, collection, root, scene)
        reaches = group_curves.reaches(scene)
        for (_, motion_id), anchor in anchors.items():
            keyframes.animate(anchor, scene, motion_id, times, options.key_tolerance, float(reaches[motion_id]))
        physics.remember(anchors, scene, times, options.key_tolerance, reaches)
        object_names.remember(collection, meanings=scene.vocabulary_embeddings is not None)
        if options.fit_timeline:
            timeline.fit(context.scene, times)
            event_markers.show(context.scene, collection)
        context.view_layer.update()
        if options.play_residuals and scene.residuals is not None and len(scene.residuals.rows):
            exact_mode.switch_on(context, collection, scene)
    if options.frame_views:
        first_view.show(context, collection)
    for selected in context.selected_objects:
        selected.select_set(False)
    root.select_set(True)
    context.view_layer.objects.active = root
    return collection


def _check_size(scene: Scene, path: Path) -> None:
    """Raise a SceneFileError if a scene has no Gaussians, or is too small for Blender's F-curves."""
    if len(scene.gaussians.means) == 0:
        raise errors.SceneFileError(
            f"{path}: expected Gaussians, found none; bake a run that was trained, or choose another file"
        )
    size = max(scene.extent, float(np.exp(scene.gaussians.log_scales.max())))
    if size < SMALLEST:
        factor = 10.0 ** -math.floor(math.log10(size))
        raise errors.SceneFileError(
            f"{path}: expected a scene of {SMALLEST:g} units or more, because Blender's animation has steps of "
            f"1e-7, found {size:.3g}; multiply the positions of the data set's cameras by {factor:g} and train again"
        )


def _objects(
    collection: bpy.types.Collection, root: bpy.types.Object, scene: Scene, sh_degree: int
) -> dict[tuple[int, int], bpy.types.Object]:
    """Create the collections of the objects with their anchors and point clouds. Returns the anchors.

    The collection of an object holds its largest point cloud with its anchor. Point clouds that another motion moves,
    and shadows with their anchors, go into a collection inside it.
    """
    parts, extent = ranges(scene), scene.extent
    largest: dict[int, Range] = {}
    for part in parts:
        largest[part.object_id] = max(largest.get(part.object_id, part), part, key=lambda own: own.count)
    material = point_clouds.material(object_names.fit(f"R5DGS {scene.name}"))
    children: dict[tuple[int, bool], bpy.types.Collection] = {}
    for part in sorted(parts, key=lambda own: (own.object_id, own != largest[own.object_id])):
        key, name = (part.object_id, part == largest[part.object_id]), object_name(scene, part.object_id)
        if key not in children:
            above = collection if key[1] else children[part.object_id, True]
            children[key] = bpy.data.collections.new(
                object_names.fit(name if key[1] else name + object_names.OTHERS_SUFFIX)
            )
            above.children.link(children[key])
    bodies = object_hulls.bodies(scene)
    hulls = {(hull.object_id, hull.motion_id): hull.vertices.ravel().tolist() for hull in scene.hulls}
    anchors = {}
    depths = {group.id: number for number, (group, _) in enumerate(group_dynamics.parts_of(scene.groups), start=1)}
    for part in sorted(anchor_ranges(scene, parts), key=lambda own: depths.get(own.motion_id, 0)):  # parents come first
        home = children[part.object_id, part == largest[part.object_id]]
        anchors[_anchor_key(part)] = anchor = _anchor(home, root, scene, part, largest, extent)
        parent = anchors.get((0, scene.groups[part.motion_id].parent))
        if parent is not None:  # locations stay in the axes of the bind state
            anchor.parent, anchor.matrix_parent_inverse = parent, Matrix.Translation(-Vector(parent.r5dgs.pivot))
    for part, data in zip(parts, compat.new_point_clouds([part.count for part in parts]), strict=True):
        point_clouds.fill(data, scene, slice(part.start, part.start + part.count), extent, sh_degree)
        data.materials.append(material)
        home = children[part.object_id, part == largest[part.object_id]]
        cloud = _cloud(home, anchors[_anchor_key(part)], scene, part, largest, data)
        if (part.object_id, part.motion_id) in bodies:
            cloud[loaded_scenes.HULL] = hulls.get((part.object_id, part.motion_id), [])
    return anchors


def object_name(scene: Scene, object_id: int) -> str:
    """Name of an object from the scene's table, or a name made from its id if the table lacks it."""
    try:
        return scene.object(object_id).name
    except KeyError:
        return "unassigned" if object_id < 0 else f"object {object_id}"


def _root(collection: bpy.types.Collection, scene: Scene, convention: str) -> bpy.types.Object:
    root = bpy.data.objects.new(object_names.fit(f"{scene.name} root"), None)
    root.r5dgs.role = "ROOT"
    root.empty_display_type = "PLAIN_AXES"
    root.empty_display_size = 0.1 * scene.extent
    root.rotation_mode = "QUATERNION"
    root.rotation_quaternion = Matrix(cameras.WORLD_TO_BLENDER[convention].tolist()).to_quaternion()
    if scene.origin.any():
        root[loaded_scenes.ORIGIN] = scene.origin.tolist()
        root.id_properties_ui(loaded_scenes.ORIGIN).update(
            description="Point of the data set's world that is shown at the root"
        )
    collection.objects.link(root)
    return root


def _pivot(scene: Scene, part: Range) -> np.ndarray:
    """Position of an anchor: the pivot or joint of the group, or for the pinned group the median of the object. [3]"""
    if part.motion_id != 0:
        return scene.groups[part.motion_id].home
    if part.object_id <= 0:
        return np.zeros(3)
    return np.median(scene.gaussians.means[part.start : part.start + part.count].astype(np.float64), axis=0)


def _anchor_key(part: Range) -> tuple[int, int]:
    """Key of the anchor that a range uses; pinned Gaussians get one anchor per object, so each can be moved."""
    return (part.object_id if part.motion_id == 0 else 0, part.motion_id)


def _part_name(scene: Scene, part: Range, largest: dict[int, Range]) -> str:
    """Name of a range: the object's name for its largest range, and a qualified name for the others."""
    name = object_name(scene, part.object_id)
    group: MotionGroup = scene.groups[part.motion_id]
    if group.role == "shadow":
        owner = object_name(scene, group.object_id)
        return f"{owner} shadow" if part.object_id <= 0 else f"{name} with {owner} shadow"
    if part == largest[part.object_id]:
        return name
    if part.motion_id and group.object_id == part.object_id:
        return f"{name} part {[g.id for g in scene.groups if _is_part(g, part.object_id)].index(group.id) + 1}"
    return f"{name} still" if part.motion_id == 0 else f"{name} with {object_name(scene, group.object_id)}"


def _is_part(group: MotionGroup, object_id: int) -> bool:
    return group.role == "body" and group.object_id == object_id


def _anchor(
    collection: bpy.types.Collection,
    root: bpy.types.Object,
    scene: Scene,
    part: Range,
    largest: dict[int, Range],
    extent: float,
) -> bpy.types.Object:
    anchor = bpy.data.objects.new(object_names.fit(f"{_part_name(scene, part, largest)} anchor"), None)
    pivot = _pivot(scene, part)
    shadow = scene.groups[part.motion_id].role == "shadow"  # shadow anchors are drawn smaller than those of bodies
    anchor.empty_display_type = "PLAIN_AXES" if shadow else "ARROWS"
    anchor.empty_display_size = (0.01 if shadow else 0.03) * extent
    anchor.rotation_mode = "QUATERNION"
    anchor.location = pivot
    anchor.parent = root
    state = anchor.r5dgs
    state.role, state.object_id, state.motion_id, state.pivot = "ANCHOR", part.object_id, part.motion_id, pivot
    collection.objects.link(anchor)
    return anchor


def _cloud(
    collection: bpy.types.Collection,
    anchor: bpy.types.Object,
    scene: Scene,
    part: Range,
    largest: dict[int, Range],
    data: bpy.types.PointCloud,
) -> bpy.types.Object:
    data.name = name = object_names.fit(_part_name(scene, part, largest))
    cloud = bpy.data.objects.new(name, data)
    collection.objects.link(cloud)
    color = srgb.to_linear(_color(scene, part.object_id))
    cloud.color = (*color, 1.0)
    cloud.parent = anchor
    pivot = Vector(anchor.r5dgs.pivot)
    cloud.matrix_parent_inverse = Matrix.Translation(-pivot)
    state = cloud.r5dgs
    state.role, state.object_id, state.motion_id, state.pivot = "CLOUD", part.object_id, part.motion_id, pivot
    state.start, state.count = part.start, part.count
    return cloud


def _color(scene: Scene, object_id: int) -> np.ndarray:
    """Mean display-referred color of an object's Gaussians, weighted by opacity. [3]"""
    rows = scene.gaussians.object_ids == object_id
    shown = 0.5 + spherical_harmonics.C0 * scene.gaussians.sh[rows, 0].astype(np.float64)
    return np.average(np.clip(shown, 0, 1), axis=0, weights=to_opacities(scene.gaussians.opacity_logits[rows]) + 1e-6)


def _describe(
    collection: bpy.types.Collection, scene: Scene, path: Path, root: bpy.types.Object, times: timeline.Times
) -> None:
    state = collection.r5dgs
    state.is_scene = True
    state.scene_name = scene.name
    state.filepath = relink.relative_to(str(path.resolve()), bpy.data.filepath)  # also trusts the file
    state.seen_at = str(path.resolve())
    state.gaussians = len(scene.gaussians.means)
    collection[loaded_scenes.SKY] = scene.background_sh.astype(np.float64).ravel().tolist()
    if scene.shading is not None:
        collection[loaded_scenes.LIGHT] = np.asarray(scene.shading.light, np.float64).tolist()
    state.root = root
    state.t_start, state.t_max, state.t_end = times.t_start, times.t_max, times.t_end
    state.frames_per_unit, state.frame_zero = times.frames_per_unit, times.frame_zero
    for item in scene.objects:
        entry = state.table.add()
        entry.name, entry.object_id = item.name, item.id
        for alias in item.aliases:
            entry.aliases.add().name = alias
        entry.caption, entry.count = item.caption, item.count

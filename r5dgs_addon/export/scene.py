"""A loaded scene with its edits as a `Scene`, and its export as a `.r5dgs` file.

The poses of the point clouds are sampled at the observed times and after t_max.
"""

from collections.abc import Collection, Generator
from dataclasses import dataclass, field, replace
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.editing import edited_scene, point_edits
from ...r5dgs_core.scene import cameras, scene_file
from ...r5dgs_core.scene.scene import Scene, SceneObject
from ..engine import render_request, visible_clouds
from ..motion import physics
from ..scene import (
    evaluated_points,
    loaded_scenes,
    object_names,
    object_tint,
    point_clouds,
    presence_keys,
    retiming,
    timeline,
)
from ..ui import plural
from ..ui.stepwise_operator import Outcome, Step, Steps
from . import frame_range

TOLERANCE = 1e-5  # tolerated difference between Blender and playback without keys, as a fraction of the scene's extent
KEY_TOLERANCE_SHARE = 1.5  # further tolerance, as a share of the key tolerance
MAX_LATER = 64  # maximum number of sampled times past t_max
MAX_EARLIER = 16  # maximum number of sampled frames before the first observed time
_STILL = 1e-6  # maximum deviation of a parent's linear part that counts as the identity


@dataclass(frozen=True)
class EditedScene:
    """A loaded scene with its edits.

    Attributes:
        scene: The scene.
        notes: Messages for the user about edits that the scene cannot hold.
        done: Number of completed steps.
    """

    scene: Scene
    notes: list[str]
    done: int


@dataclass
class _Member:
    """Point cloud with its poses over time. matrices [4, 4] each; pivot [3], parent [3, 3] and points at t_max.

    ``keys``: one key per distinct state of the points over time; more than one if modifiers animate them
    """

    cloud: bpy.types.Object
    anchor: bpy.types.Object | None
    object_id: int
    matrices: list[np.ndarray] = field(default_factory=list)
    pivot: np.ndarray | None = None
    parent: np.ndarray | None = None
    absent: list[bool] = field(default_factory=list)
    points: evaluated_points.Comparison = field(default_factory=evaluated_points.Comparison)
    keys: set[str] = field(default_factory=set)


def steps(context: bpy.types.Context, collection: bpy.types.Collection, path: Path, *, exact: bool = False) -> Steps:
    """Write a loaded scene with its edits.

    Args:
        context: Context with the scene's frames.
        collection: Loaded scene.
        path: Output file; must not be the source of a loaded scene.
        exact: True to store all numbers in full precision.

    Raises:
        ConfigError: The path is the source of a loaded scene, or a point cloud has lost its points.
        SceneFileError: The scene's own file is missing, or the new one cannot be written.
    """
    refuse_sources(path)
    edited = yield from edited_steps(context, collection, further=1)
    result, what = edited.scene, plural.of(len(edited.scene.gaussians.means), "Gaussian")
    yield Step(edited.done, edited.done + 1, f"packing {what} into {path.name}", slow=True)
    scene_file.write(result, path, precision="exact" if exact else "compact")
    named = sum(item.id > 0 for item in result.objects)
    return Outcome(f"{path.name}: {what}, {plural.of(named, 'object')}", edited.notes)


def edited_steps(
    context: bpy.types.Context,
    collection: bpy.types.Collection,
    clouds: Collection[bpy.types.Object] | None = None,
    *,
    further: int,
) -> Generator[Step, None, EditedScene]:
    """Apply the edits of a loaded scene. Blender's current frame is restored at the end.

    Args:
        context: Context with the scene's frames.
        collection: Loaded scene.
        clouds: Point clouds to keep; None for all.
        further: Number of steps that the caller adds.

    Raises:
        ConfigError: A point cloud has lost its points.
        SceneFileError: The scene's own file is missing.
    """
    own = render_request.scene_path(collection)
    source = scene_file.read(own)
    times = timeline.of_collection(collection)
    members, names = _members(collection)
    members = [member for member in members if clouds is None or member.cloud in clouds]
    if any(member.cloud.r5dgs.start + member.cloud.r5dgs.count > len(source.gaussians.means) for member in members):
        raise errors.SceneFileError(
            f"{own}: expected the scene that '{collection.name}' was loaded from, found another one; load it again"
        )
    when = np.concatenate([source.tracks.times, _later(times)])
    earlier, total = _earlier(context.scene, times), len(when) + 1 + further
    with frame_range.frame_kept(context.scene), presence_keys.ignored([member.cloud for member in members]):
        before = []
        for frame in earlier:
            depsgraph, back = _go_to(context, collection, frame)
            before.append([back @ _matrix(member.cloud, depsgraph) for member in members])
        for number, t in enumerate(when):
            yield Step(number, total, f"frame {times.frame(t):.4g}")
            _record_poses(
                context, collection, members, times.frame(float(t)), bind=number == len(source.tracks.times) - 1
            )
    yield Step(len(when), total, "fitting the edited motion", slow=True)
    changed = [member for member in members if member.points.edit is not None]
    extended, places = point_edits.extend(source, [member.points.edit.points for member in changed])
    placed = {id(member): place for member, place in zip(changed, places, strict=True)}
    pieces = [piece for member in members for piece in _pieces(member, extended, placed.get(id(member)))]
    result, notes = edited_scene.edit(extended, pieces, when, _table(collection, source, members, names))
    notes += _lost_points(members, source, extended)
    retimed = [one.cloud.name for one in members if _bends_retimed(one.cloud)]
    if retimed:
        notes.append(f"{', '.join(retimed)}: retimed; the motion of single Gaussians keeps its original times")
    lost = _moving_before(members, before, TOLERANCE * source.extent, source.extent)
    if lost:
        notes.append(
            f"{', '.join(lost)}: motion before frame {times.frame(times.t_start):.4g}, the first observed time, is not "
            "exported; move those keys after it"
        )
    if not _is_root_unmoved(collection):
        notes.append("The root was moved; positions in the file are relative to the root")
    return EditedScene(result, notes, len(when) + 1)


def _bends_retimed(cloud: bpy.types.Object) -> bool:
    """True if a cloud has points that bend, and is retimed."""
    bound = point_clouds.attribute(cloud.data, point_clouds.BIND + "position", "FLOAT_VECTOR")
    return bound is not None and retiming.strip_of(cloud.parent) is not None


def _lost_points(members: list[_Member], source: Scene, extended: Scene) -> list[str]:
    """Messages about edited points that the file cannot hold."""
    notes = [note for member in members for note in member.points.notes]
    animated = [member.cloud.name for member in members if len(member.keys) > 1]
    if animated:
        notes.append(f"{', '.join(animated)}: points that modifiers animate are written as they are at t_max")
    lost = [name for name in ("dynamics", "canonical_means") if name not in extended.arrays()]
    notes += [f"'{name}' of edited points is left out" for name in lost if name in source.arrays()]
    return notes


def refuse_sources(path: Path) -> None:
    """Raise ConfigError if a path is the scene file of a loaded scene."""
    for collection in loaded_scenes.scene_collections():
        try:
            own = render_request.scene_path(collection)
        except errors.R5dgsError:
            continue
        if path.exists() and path.samefile(own):
            raise errors.ConfigError(
                f"{path}: '{collection.name}' plays from this file; save the edited scene under another name"
            )


def _later(times: timeline.Times) -> np.ndarray:
    """Times past t_max at which Blender's F-curves are sampled: whole frames, and the last key's time."""
    first, last = times.frame(times.t_max), times.frame(times.t_end)
    if last <= first + 1e-6:
        return np.zeros(0)
    count = int(min(max(np.ceil(last - first), 8), MAX_LATER))
    return times.t_max + (times.t_end - times.t_max) * np.arange(1, count + 1) / count


def _earlier(scene: bpy.types.Scene, times: timeline.Times) -> list[int]:
    """Frames before the first observed time, which a scene file cannot hold."""
    first, end = scene.frame_start, int(np.ceil(times.frame(times.t_start) - 1e-6))
    return sorted({int(frame) for frame in np.linspace(first, end - 1, MAX_EARLIER)}) if first < end else []


def _go_to(
    context: bpy.types.Context, collection: bpy.types.Collection, frame: float
) -> tuple[bpy.types.Depsgraph, np.ndarray]:
    """Go to a frame. Returns the depsgraph and the transform from Blender's world to the file's. [4, 4]"""
    whole = int(np.floor(frame))
    context.scene.frame_set(whole, subframe=min(float(frame - whole), 0.999999))
    depsgraph = context.evaluated_depsgraph_get()
    return depsgraph, np.linalg.inv(visible_clouds.world_of(collection, depsgraph))


def _moving_before(members: list[_Member], before: list[list[np.ndarray]], allowed: float, extent: float) -> list[str]:
    """Names of the point clouds whose pose before the first observed time differs from the pose at that time."""
    names = []
    for number, member in enumerate(members):
        changes = [np.abs(matrices[number] - member.matrices[0]) for matrices in before]
        if any(max(extent * change[:3, :3].max(), change[:3, 3].max()) > allowed for change in changes):
            names.append(member.cloud.name)
    return names


def _members(collection: bpy.types.Collection) -> tuple[list[_Member], dict[int, tuple[str, int]]]:
    """Point clouds of a scene, and name and original of each copied object, which gets its own id."""
    found, names = [], {}
    clouds = [obj for obj in loaded_scenes.members(collection, "CLOUD") if obj.type == "POINTCLOUD"]
    clouds.sort(key=lambda obj: (obj.r5dgs.start, len(obj.name), obj.name))
    free = max([entry.object_id for entry in collection.r5dgs.table] + [0]) + 1
    anchors: dict[tuple[int, int, int], list[bpy.types.Object | None]] = {}
    copies: dict[tuple[int, bpy.types.Collection], int] = {}
    for cloud in clouds:
        state, anchor = cloud.r5dgs, _anchor(cloud)
        rows = anchors.setdefault((state.object_id, state.start, state.count), [])
        rows.append(anchor)
        object_id, home = state.object_id, cloud.users_collection[0]
        if object_id > 0 and len(rows) > 1:
            if (object_id, home) not in copies:
                copies[object_id, home] = free
                names[free] = (home.name if home != collection else cloud.name, object_id)
                free += 1
            object_id = copies[object_id, home]
        found.append(_Member(cloud, anchor, object_id))
    return found, names


def _anchor(cloud: bpy.types.Object) -> bpy.types.Object | None:
    parent = cloud.parent
    return parent if parent is not None and parent.r5dgs.role == "ANCHOR" else None


def _record_poses(
    context: bpy.types.Context, collection: bpy.types.Collection, members: list[_Member], frame: float, bind: bool
) -> None:
    """Record the pose of each point cloud in the file's world; at t_max (``bind``), also points and anchor."""
    depsgraph, back = _go_to(context, collection, frame)
    for member in members:
        member.matrices.append(back @ _matrix(member.cloud, depsgraph))
        member.absent += presence_keys.absent_at(member.cloud, [frame]).tolist()
        found = evaluated_points.of(member.cloud, depsgraph, collection.r5dgs.gaussians)
        if found.edit is None or not found.edit.bent:
            member.keys.add("" if found.edit is None else found.edit.key)
        if bind:
            member.points = found
        if bind and member.anchor is not None:
            member.pivot = (back @ _matrix(member.anchor, depsgraph))[:3, 3]
            parent = member.anchor.parent
            outer = np.eye(4) if parent is None else _matrix(parent, depsgraph)
            linear = (back @ outer @ np.array(member.anchor.matrix_parent_inverse, np.float64))[:3, :3]
            member.parent = np.eye(3) if np.abs(linear - np.eye(3)).max() < _STILL else linear


def _matrix(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    return np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)


def _pieces(member: _Member, source: Scene, place: point_edits.Place | None) -> list[edited_scene.Piece]:
    """Convert a point cloud to a `Piece` for the core, or an empty list if it is scaled to zero.

    Args:
        member: Point cloud with its poses.
        source: Scene, extended by edited points.
        place: Range of its points in ``source`` if they were edited.
    """
    cloud, anchor, matrices = member.cloud, member.anchor, np.array(member.matrices)
    bind = matrices[len(source.tracks.times) - 1]
    start, count = cloud.r5dgs.start, cloud.r5dgs.count
    if place is not None:
        start, count, matrices = place.start, place.count, matrices @ place.matrix
    if visible_clouds.flat([bind])[0]:  # scaled to zero
        return []
    remembers = anchor is not None and physics.has_motion(anchor)
    keys = physics.key_error(anchor)[0] if remembers else 0.0
    model = physics.model(anchor) if remembers else None
    return [
        edited_scene.Piece(
            name=cloud.name,
            object_id=member.object_id,
            motion_id=cloud.r5dgs.motion_id,
            start=start,
            count=count,
            mover=cloud.name if anchor is None else anchor.name,
            matrices=matrices,
            pivot=member.pivot,
            parent=member.parent,
            model=model,
            allowed=TOLERANCE * source.extent + KEY_TOLERANCE_SHARE * keys,
            tint=object_tint.tint(cloud) if object_tint.is_tinted(cloud) else None,
            absent=np.array(member.absent, bool),
        )
    ]


def _table(
    collection: bpy.types.Collection, source: Scene, members: list[_Member], copies: dict[int, tuple[str, int]]
) -> dict[int, SceneObject]:
    """Current names, aliases, captions and colours of the objects."""
    colors = {item.id: item.color for item in source.objects}
    tints = {member.object_id: object_tint.tint(member.cloud) for member in reversed(members)}
    result = {}
    current = object_names.names(collection)
    for entry in collection.r5dgs.table:
        aliases = tuple(alias.name for alias in entry.aliases if alias.name)
        color = colors.get(entry.object_id, (0.5, 0.5, 0.5))
        name = current.get(entry.object_id, entry.name) or f"object {entry.object_id}"
        result[entry.object_id] = SceneObject(entry.object_id, name, aliases, entry.caption, color, 0, 0)
    for object_id, (name, original) in copies.items():
        if original in result:
            result[object_id] = replace(result[original], id=object_id, name=name)
    for object_id, tint in tints.items():
        if object_id in result and tuple(tint) != object_tint.NONE:
            color = np.clip(np.array(result[object_id].color) * tint, 0, 1)
            result[object_id] = replace(result[object_id], color=tuple(color.tolist()))
    return result


def _is_root_unmoved(collection: bpy.types.Collection) -> bool:
    """Return True if the transform of the root is only a world convention."""
    world = visible_clouds.world_of(collection)
    turns = cameras.WORLD_TO_BLENDER.values()
    return not world[:3, 3].any() and any(np.allclose(world[:3, :3], turn, atol=1e-5) for turn in turns)

"""Posed Gaussians for one picture: a playback frame, or ranges of scenes' Gaussians, each with its own matrix."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import quaternion_columns, rotations
from ..playback import affine_transform, posing, scene_player
from ..playback.residuals import Residuals
from ..scene import diffuse_shading
from ..scene.instance import Instance
from ..scene.scene import Scene

MANY = 16  # shortest run of equal instances whose rows are gathered


@dataclass(frozen=True)
class JoinedScenes:
    """The Gaussians of several scenes, concatenated. S scenes.

    Attributes:
        means, quats, log_scales, opacity_logits, object_ids: As in `Scene`.
        sh: Padded with zeros to the largest degree. [N, K, 3]
        starts: First row of each scene, and N. [S + 1]
        shading: As in `Scene`, zero for scenes without shading; None if no scene has it. [N, 3]
        shading_rest: Shading factor in the bind state, not clamped. [N]
        lights: Light direction of each scene, None for those without shading.
        residuals: Function per scene that returns its residuals, computed on the first call.
        harmonics_turn: As in `Scene`.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    object_ids: np.ndarray
    sh: np.ndarray
    starts: tuple[int, ...]
    shading: np.ndarray | None
    shading_rest: np.ndarray | None
    lights: tuple[np.ndarray | None, ...]
    residuals: tuple[Callable[[], Residuals], ...]
    harmonics_turn: tuple[bool, ...]


def join_scenes(scenes: Sequence[Scene]) -> JoinedScenes:
    """Concatenate the Gaussians of scenes. A single scene is not copied."""
    lit = any(scene.shading is not None for scene in scenes)
    bases = max((scene.gaussians.sh.shape[1] for scene in scenes), default=1)

    def stacked(arrays: list[np.ndarray], shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        return arrays[0] if len(arrays) == 1 else np.concatenate([np.empty((0, *shape), dtype), *arrays])

    def padded(sh: np.ndarray) -> np.ndarray:
        return sh if sh.shape[1] == bases else np.pad(sh, ((0, 0), (0, bases - sh.shape[1]), (0, 0)))

    def vectors(scene: Scene) -> np.ndarray:
        return (
            scene.shading.vectors
            if scene.shading is not None
            else np.zeros((len(scene.gaussians.means), 3), np.float32)
        )

    return JoinedScenes(
        means=stacked([scene.gaussians.means for scene in scenes], (3,)),
        quats=stacked([scene.gaussians.quats for scene in scenes], (4,)),
        log_scales=stacked([scene.gaussians.log_scales for scene in scenes], (3,)),
        opacity_logits=stacked([scene.gaussians.opacity_logits for scene in scenes], ()),
        object_ids=stacked([scene.gaussians.object_ids for scene in scenes], (), np.int32),
        sh=stacked([padded(scene.gaussians.sh) for scene in scenes], (bases, 3)),
        starts=(0, *(int(stop) for stop in np.cumsum([len(scene.gaussians.means) for scene in scenes]))),
        shading=stacked([vectors(scene) for scene in scenes], (3,)) if lit else None,
        shading_rest=stacked([diffuse_shading.rest_factors(scene) for scene in scenes], ()) if lit else None,
        lights=tuple(
            None if scene.shading is None else np.asarray(scene.shading.light, np.float64) for scene in scenes
        ),
        residuals=tuple(functools.cache(functools.partial(Residuals, scene)) for scene in scenes),
        harmonics_turn=tuple(scene.harmonics_turn for scene in scenes),
    )


@dataclass(frozen=True)
class PosedScene:
    """Gaussians in the world, with the bind-state data that their colours depend on. P poses.

    Attributes:
        means: Centres relative to ``origin``, world axes. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Logarithms of the standard deviations. [N, 3] float32
        opacity_logits: Opacities before the sigmoid. [N] float32
        sh: Spherical harmonics in the bind frame. [N, K, 3] float32
        object_ids: Object of each Gaussian. [N] int32
        view_maps: Linear maps from world directions to the bind frame, not normalised. [P, 3, 3]
        pose_ids: Pose of each Gaussian, a row of ``view_maps``. [N] int64
        shading_factor: Factor on the colour, or None. [N] float32
        origin: Point of the world that ``means`` are relative to. [3] float64
        tints: Factors on red, green and blue of each pose, or None. [P, 3] float32
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    object_ids: np.ndarray
    view_maps: np.ndarray
    pose_ids: np.ndarray
    shading_factor: np.ndarray | None
    origin: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    tints: np.ndarray | None = None


def pose_frame(scene: Scene, frame: scene_player.Frame) -> PosedScene:
    """Return the Gaussians of a frame of `scene_player`."""
    view_maps, pose_ids = scene_player.sh_rotations(frame.group_quats), frame.motion_ids.astype(np.int64)
    if frame.turned_rows is not None and frame.turned_quats is not None and frame.sh.shape[1] > 1:
        pose_ids[frame.turned_rows] = len(view_maps) + np.arange(len(frame.turned_rows))
        view_maps = np.concatenate([view_maps, scene_player.sh_rotations(frame.turned_quats)])
    return PosedScene(
        means=frame.means,
        quats=frame.quats,
        log_scales=frame.log_scales,
        opacity_logits=frame.opacity_logits,
        sh=frame.sh,
        object_ids=frame.object_ids,
        view_maps=view_maps,
        pose_ids=pose_ids,
        shading_factor=frame.shading_factor,
        origin=frame.origin,
    )


def rows_of(posed: PosedScene, rows: np.ndarray) -> PosedScene:
    """Return some rows of posed Gaussians. [n] int"""
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "pose_ids", "shading_factor")
    found = {name: getattr(posed, name) for name in names}
    return dataclasses.replace(posed, **{name: x[rows] for name, x in found.items() if x is not None})


def with_moved(posed: PosedScene, other: PosedScene, moved: np.ndarray) -> PosedScene:
    """Replace positions, rotations and shading factors of the rows in ``moved`` by those of ``other``. [N] bool"""

    def mixed(here: np.ndarray, there: np.ndarray) -> np.ndarray:
        return np.where(moved.reshape(-1, *[1] * (here.ndim - 1)), there, here)

    factor = None
    if posed.shading_factor is not None and other.shading_factor is not None:
        factor = mixed(posed.shading_factor, other.shading_factor)
    means, quats = mixed(posed.means, other.means), mixed(posed.quats, other.quats)
    return dataclasses.replace(posed, means=means, quats=quats, shading_factor=factor)


def pose_instances(scene: Scene | JoinedScenes, instances: Sequence[Instance]) -> PosedScene:
    """Transform ranges of the Gaussians of one or several scenes, each by its own matrix.

    Ranges may repeat or be left out. Rotations, translations and uniform scales are exact. Under any other linear map
    the ellipsoids are mapped exactly, and the viewing direction by the inverse. Shading follows the rotation nearest to
    the map, relative to the scene's own world.

    Args:
        scene: One scene, or several from `join_scenes`.
        instances: Ranges and their maps.

    Returns:
        The Gaussians, in the order of ``instances``.

    Raises:
        ValueError: A range leaves its scene, a matrix is singular or not finite, or a tint is negative.
    """
    given = scene if isinstance(scene, JoinedScenes) else join_scenes([scene])
    ranges = [_rows(given, index, instance) for index, instance in enumerate(instances)]
    total = sum(instance.count for instance in instances)
    means, quats, log_scales = (np.empty((total, width), np.float32) for width in (3, 4, 3))
    shading, pose_ids = np.ones(total, np.float32), np.empty(total, np.int64)
    view_maps, tints, poses, filled = [np.eye(3)[None]], [np.ones((1, 3))], 1, 0
    for index, part in _parts(instances, ranges):
        instance = instances[index]
        linear, offset = affine(instance.matrix, index)
        to = slice(filled, filled + (part.stop - part.start if isinstance(part, slice) else len(part)))
        posing.move_points(given.means[part], linear, offset, means[to])
        affine_transform.map_shapes(linear, given.quats[part], given.log_scales[part], quats[to], log_scales[to])
        light = given.lights[instance.scene]
        rotation = _rotation(instance, index, linear, light)
        shading[to], pose_ids[to] = _shading(given, part, rotation, light), poses
        maps = np.linalg.inv(linear)[None]
        bent = _bent(given, instance, part)
        if bent is not None:
            rows, at = bent.rows, filled + bent.places
            means[at] = (given.means[rows] + bent.offsets) @ linear.T + offset
            shapes = np.empty((len(at), 4), np.float32), np.empty((len(at), 3), np.float32)
            affine_transform.map_shapes(linear, bent.quats, given.log_scales[rows] + bent.growths, *shapes)
            quats[at], log_scales[at] = shapes
            turns = rotations.quats_to_rotmats(bent.turns)
            shading[at] = _shading(given, rows, rotation @ turns, light)
            if given.harmonics_turn[instance.scene] and given.sh.shape[1] > 1:
                pose_ids[at] = poses + 1 + np.arange(len(at))
                maps = np.concatenate([maps, np.swapaxes(turns, -1, -2) @ maps])
        view_maps.append(maps)
        tints.append(np.broadcast_to(_tint(instance, index), (len(maps), 3)))
        poses, filled = poses + len(maps), to.stop
    return PosedScene(
        means=means,
        quats=quats,
        log_scales=log_scales,
        opacity_logits=_take(given.opacity_logits, ranges),
        sh=_take(given.sh, ranges),
        object_ids=_take(given.object_ids, ranges),
        view_maps=np.concatenate(view_maps),
        pose_ids=pose_ids,
        shading_factor=shading if given.shading is not None else None,
        tints=None if all(one.tint is None for one in instances) else np.concatenate(tints).astype(np.float32),
    )


def _rotation(instance: Instance, index: int, linear: np.ndarray, light: np.ndarray | None) -> np.ndarray:
    """Rotation of an instance relative to its scene's world, for shading; the identity without a light. [3, 3]"""
    world = None if instance.world is None else affine(instance.world, index)[0]
    if light is None:
        return np.eye(3)
    rotation = affine_transform.nearest_rotation(linear)
    return rotation if world is None else affine_transform.nearest_rotation(world).T @ rotation


@dataclass(frozen=True)
class _ResidualRows:
    """Gaussians with residuals, in the bind state: rows in the `JoinedScenes` arrays [R], indices within the part [R],
    offsets [R, 3], resulting rotations, unit wxyz [R, 4], residual rotations [R, 4] and residuals of the log scales
    [R, 3]."""

    rows: np.ndarray
    places: np.ndarray
    offsets: np.ndarray
    quats: np.ndarray
    turns: np.ndarray
    growths: np.ndarray


def has_residuals(given: JoinedScenes, instance: Instance) -> bool:
    """Return True if an instance contains Gaussians with residuals."""
    if instance.t is None or not 0 <= instance.scene < len(given.residuals):
        return False
    rows = given.residuals[instance.scene]().rows
    return bool(np.searchsorted(rows, instance.start) < np.searchsorted(rows, instance.start + instance.count))


def _bent(given: JoinedScenes, instance: Instance, part: slice | np.ndarray) -> _ResidualRows | None:
    if instance.t is None:
        return None
    residuals = given.residuals[instance.scene]()
    found, known = residuals.at(float(instance.t)), given.starts[instance.scene] + residuals.rows
    if found is None:
        return None
    if isinstance(part, slice):
        which = np.arange(*np.searchsorted(known, (part.start, part.stop)))
        places = known[which] - part.start
    else:
        near = np.minimum(np.searchsorted(known, part), len(known) - 1)
        places = np.flatnonzero(known[near] == part)
        which = near[places]
    if len(which) == 0:
        return None
    offsets, turns, growths = (values[:, which] for values in found)
    turned = quaternion_columns.multiply(turns.astype(np.float32), residuals.bind_quats[:, which])
    return _ResidualRows(known[which], places, offsets.T, np.ascontiguousarray(turned.T), turns.T, growths.T)


def _parts(
    instances: Sequence[Instance], ranges: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, slice | np.ndarray]]:
    """Yield the parts that are transformed in one call: index of the first instance, and the part's gathered rows.

    A part is usually one instance. Long runs of instances that differ only in their ranges form one part: a point
    cloud with deleted points consists of many such ranges.
    """
    keys = [(one.scene, np.asarray(one.matrix).tobytes(), _bytes(one.world), one.tint, one.t) for one in instances]
    index = 0
    for _, same in itertools.groupby(keys):
        count = len(list(same))
        if count < MANY:
            yield from ((i, slice(*ranges[i])) for i in range(index, index + count))
        else:
            yield index, np.concatenate([np.arange(*ranges[i]) for i in range(index, index + count)])
        index += count


def _bytes(matrix: np.ndarray | None) -> bytes:
    return b"" if matrix is None else np.asarray(matrix).tobytes()


def affine(matrix: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Linear part and translation of an invertible [4, 4] matrix; errors name the instance."""
    try:
        return affine_transform.affine(matrix)
    except ValueError as error:
        raise ValueError(f"instance {index}: {error}; hide the object instead") from error


def _rows(given: JoinedScenes, index: int, instance: Instance) -> tuple[int, int]:
    """Return the first row of an instance in the joined scenes, and the row past its last."""
    if not 0 <= instance.scene < len(given.starts) - 1:
        raise ValueError(f"instance {index}: expected a scene below {len(given.starts) - 1}, got {instance.scene}")
    first, end = given.starts[instance.scene : instance.scene + 2]
    start, stop = instance.start, instance.start + instance.count
    if not 0 <= start <= stop <= end - first:
        raise ValueError(f"instance {index}: rows {start}:{stop} leave the scene's {end - first} Gaussians")
    return first + start, first + stop


def _tint(instance: Instance, index: int) -> np.ndarray:
    """Return the checked colour factors of an instance. [3]"""
    if instance.tint is None:
        return np.ones(3)
    tint = np.asarray(instance.tint, np.float64)
    if tint.shape != (3,) or not np.isfinite(tint).all() or (tint < 0).any():
        raise ValueError(f"instance {index}: expected a tint of three factors >= 0, got {instance.tint!r}")
    return tint


def _take(array: np.ndarray, ranges: Sequence[tuple[int, int]]) -> np.ndarray:
    """Concatenate ranges of rows; return the array itself if they cover it in order."""
    edges = [0, *(edge for start, stop in ranges for edge in (start, stop)), len(array)]
    if all(before == after for before, after in zip(edges[::2], edges[1::2], strict=True)):
        return array
    return np.concatenate([array[:0], *(array[start:stop] for start, stop in ranges)])


def _shading(given: JoinedScenes, rows: slice | np.ndarray, turns: np.ndarray, light: np.ndarray | None) -> np.ndarray:
    """Shading factors of rotated rows under a light; one rotation [3, 3], or one per row [n, 3, 3]. [n] float32"""
    if given.shading is None or given.shading_rest is None or light is None:
        return np.ones(len(given.means[rows]), np.float32)
    change = diffuse_shading.light_change(light, turns).astype(np.float32)
    return diffuse_shading.factors(given.shading_rest[rows], given.shading[rows], change)

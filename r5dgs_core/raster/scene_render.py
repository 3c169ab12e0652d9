"""A posed scene to a picture: the one place where evaluation, the worker and export turn Gaussians of a `Scene` into
pixels.

Colour of a Gaussian: max(0, 0.5 + SH(A^-1 d)) times max(0, shading factor) as in training, with d the viewing
direction in the world and A the map that brought the Gaussian from its bind state; times a tint where it has one.
Behind everything lies the scene's sky, the spherical harmonics `Scene.background_sh` along each pixel's ray, within
[0, 1] as in training.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..model import spherical_harmonics
from ..motion import rotations
from ..scene import playback
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import RasterSettings, RenderOutput, harmonics, rasterize

SIMILARITY_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Instance:
    """A range of a scene's Gaussians somewhere else than in its bind state.

    Attributes:
        start: First row.
        count: Number of rows.
        matrix: Affine map from the bind state to the world of the picture. [4, 4]
        scene: Which of several scenes.
        world: Map from that scene's own world, in which its light stands, to the world of the picture; None where they
            are the same. [4, 4]
        tint: Factors >= 0 on the display-referred red, green and blue; None for 1.
    """

    start: int
    count: int
    matrix: np.ndarray
    scene: int = 0
    world: np.ndarray | None = None
    tint: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Gathered:
    """The Gaussians of several scenes one after the other, as one set of arrays. S scenes.

    Attributes:
        means, quats, log_scales, opacity_logits, object_ids: As in `Scene`.
        sh: Of the largest degree, zero where a scene's is smaller. [N, K, 3]
        starts: First row of each scene, and N. [S + 1]
        shading: As in `Scene`, zero for scenes without; None where no scene has it. [N, 3]
        shading_rest: Factor in the bind state, not bounded. [N]
        lights: The scenes' light directions, None for those without shading.
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


def gather(scenes: Sequence[Scene]) -> Gathered:
    """The Gaussians of scenes as one set; of one scene, or none, nothing is copied."""
    lit = [scene.shading is not None and scene.light_direction is not None for scene in scenes]
    bases = max((scene.sh.shape[1] for scene in scenes), default=1)

    def stacked(arrays: list[np.ndarray], shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        return arrays[0] if len(arrays) == 1 else np.concatenate([np.empty((0, *shape), dtype), *arrays])

    def padded(sh: np.ndarray) -> np.ndarray:
        return sh if sh.shape[1] == bases else np.pad(sh, ((0, 0), (0, bases - sh.shape[1]), (0, 0)))

    def vectors(scene: Scene) -> np.ndarray:
        return scene.shading if scene.shading is not None else np.zeros((len(scene.means), 3), np.float32)

    def rest(scene: Scene, shaded: bool) -> np.ndarray:
        return playback.rest_factors(scene) if shaded else np.ones(len(scene.means), np.float32)

    return Gathered(
        means=stacked([scene.means for scene in scenes], (3,)),
        quats=stacked([scene.quats for scene in scenes], (4,)),
        log_scales=stacked([scene.log_scales for scene in scenes], (3,)),
        opacity_logits=stacked([scene.opacity_logits for scene in scenes], ()),
        object_ids=stacked([scene.object_ids for scene in scenes], (), np.int32),
        sh=stacked([padded(scene.sh) for scene in scenes], (bases, 3)),
        starts=(0, *(int(stop) for stop in np.cumsum([len(scene.means) for scene in scenes]))),
        shading=stacked([vectors(scene) for scene in scenes], (3,)) if any(lit) else None,
        shading_rest=stacked([rest(*pair) for pair in zip(scenes, lit, strict=True)], ()) if any(lit) else None,
        lights=tuple(
            np.asarray(scene.light_direction, np.float64) if shaded else None
            for scene, shaded in zip(scenes, lit, strict=True)
        ),
    )


@dataclass(frozen=True)
class PosedScene:
    """Gaussians in the world, with what their colour needs of the bind state. P poses.

    Attributes:
        means: Centres, world. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Logarithms of the standard deviations. [N, 3] float32
        opacity_logits: Before the sigmoid. [N] float32
        sh: Spherical harmonics in the bind frame. [N, K, 3] float32
        object_ids: [N] int32
        view_maps: Linear maps that bring world directions into the bind frame, up to length. [P, 3, 3]
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


def pose_frame(scene: Scene, frame: playback.Frame) -> PosedScene:
    """The Gaussians of a frame of `playback`."""
    view_maps, pose_ids = playback.sh_rotations(frame.group_quats), frame.motion_ids.astype(np.int64)
    if frame.turned_rows is not None and frame.turned_quats is not None and frame.sh.shape[1] > 1:
        pose_ids[frame.turned_rows] = len(view_maps) + np.arange(len(frame.turned_rows))
        view_maps = np.concatenate([view_maps, playback.sh_rotations(frame.turned_quats)])
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


def pose_instances(scene: Scene | Gathered, instances: Sequence[Instance]) -> PosedScene:
    """Ranges of the Gaussians of a scene or of several, each moved by a matrix of its own.

    A range may appear several times, or not at all. Rotation, translation and uniform scale are exact in every respect;
    under any other linear map the ellipsoids are still mapped exactly and the viewing direction is brought back by the
    inverse. Shading turns with the rotation that is nearest to the map, seen from the scene's own world.

    Args:
        scene: The scene, or several that were gathered.
        instances: Ranges and their maps.

    Returns:
        The Gaussians, in the order of ``instances``.

    Raises:
        ValueError: A range leaves its scene, a matrix flattens space or is not finite, or a tint is negative.
    """
    given = scene if isinstance(scene, Gathered) else gather([scene])
    ranges = [_rows(given, index, instance) for index, instance in enumerate(instances)]
    total, view_maps = sum(instance.count for instance in instances), [np.eye(3)]
    means, quats, log_scales = (np.empty((total, width), np.float32) for width in (3, 4, 3))
    shading, pose_ids = np.ones(total, np.float32), np.empty(total, np.int64)
    filled = 0
    for index, instance in enumerate(instances):
        linear, offset = _affine(instance.matrix, index)
        part, to = slice(*ranges[index]), slice(filled, filled + instance.count)
        playback.move_points(given.means[part], linear, offset, means[to])
        rotation = _map_shapes(linear, given.quats[part], given.log_scales[part], quats[to], log_scales[to])
        if instance.world is not None:
            rotation = _nearest_rotation(_affine(instance.world, index)[0]).T @ rotation
        shading[to] = _shading(given, part, rotation, given.lights[instance.scene])
        pose_ids[to] = len(view_maps)
        view_maps.append(np.linalg.inv(linear))
        filled = to.stop
    return PosedScene(
        means=means,
        quats=quats,
        log_scales=log_scales,
        opacity_logits=_take(given.opacity_logits, ranges),
        sh=_take(given.sh, ranges),
        object_ids=_take(given.object_ids, ranges),
        view_maps=np.stack(view_maps),
        pose_ids=pose_ids,
        shading_factor=shading if given.shading is not None else None,
        tints=_tints(instances),
    )


def render_frame(
    scene: Scene,
    pose: playback.Frame | PosedScene,
    camera: Camera,
    *,
    background: str | np.ndarray | None = "scene",
    backend: str = "auto",
    features: np.ndarray | None = None,
    settings: RasterSettings | None = None,
) -> RenderOutput:
    """Render a scene in a pose.

    Args:
        scene: The scene; its sky is the background.
        pose: A frame of `playback`, or what `pose_frame` and `pose_instances` give.
        camera: The camera, in the scene's world.
        background: "scene" for the sky, None for black, or a colour [3] or image [H, W, 3].
        backend: Rasterizer: "auto", "cpu", "cuda" or "reference".
        features: More channels to blend beside the colour. [N, F]
        settings: Of the rasterizer; the defaults with the scene's near plane where None.

    Returns:
        Colour (not clamped at 1), alpha, depth, features and object ids, tensors without gradient.
    """
    posed = pose_frame(scene, pose) if isinstance(pose, playback.Frame) else pose
    if isinstance(background, str):
        if background != "scene":
            raise ValueError(f"background: expected 'scene', None or an array, got {background!r}")
        background = behind(scene, camera)
    with torch.no_grad():
        return rasterize(
            PosedGaussians(posed),
            _relative(camera, posed.origin),
            None if features is None else torch.from_numpy(np.ascontiguousarray(features, np.float32)),
            None if background is None else tensor(background),
            colors=tensor(colors(posed, camera)),
            settings=settings or RasterSettings(near_plane=scene.near_plane),
            backend=backend,
        )


def sky(scene: Scene, camera: Camera) -> np.ndarray:
    """The scene's background as this camera sees it, display-referred sRGB. [H, W, 3] float32"""
    return harmonics.sky(scene.background_sh, camera)


def in_world_of(camera: Camera, matrix: np.ndarray) -> Camera:
    """A camera whose rays have the directions that another's have in a world that a map brings to that other's.

    Args:
        camera: The camera.
        matrix: Affine map to the camera's world; what it shifts has no part in directions. [4, 4]

    Returns:
        A camera for `sky`, and for nothing else: it is rigid only where the map turns alone.

    Raises:
        ValueError: The matrix flattens space or is not finite.
    """
    linear, _ = _affine(matrix, 0)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = camera.T_cam_world[:3, :3] @ np.linalg.inv(linear).T
    return dataclasses.replace(camera, T_cam_world=T_cam_world)


def colors(posed: PosedScene, camera: Camera) -> np.ndarray:
    """Display-referred colour of every Gaussian as this camera sees it, >= 0. [N, 3] float32"""
    factor = posed.shading_factor
    if posed.sh.shape[1] == 1:
        rgb = np.maximum(spherical_harmonics.dc_to_rgb(np.asarray(posed.sh[:, 0], np.float32)), 0)
        if factor is not None:
            for channel in range(3):  # a column at a time: numpy is slow at rows of three
                rgb[:, channel] *= factor
    else:
        with torch.no_grad():
            rgb = harmonics.seen_colors(
                tensor(posed.means),
                tensor(posed.sh),
                camera.center - posed.origin,
                view_maps=posed.view_maps,
                pose_ids=posed.pose_ids,
                factor=None if factor is None else tensor(factor),
            ).numpy()
    if posed.tints is not None:  # >= 0: the same as on the harmonics, t (0.5 + SH), before the bound at 0
        for channel in range(3):
            rgb[:, channel] *= posed.tints[:, channel][posed.pose_ids]
    return rgb


def behind(scene: Scene, camera: Camera) -> np.ndarray:
    """`sky`, but one colour where it is one. [3] or [H, W, 3]"""
    image = sky(scene, camera)
    return image[0, 0] if len(scene.background_sh) == 1 else image


def _relative(camera: Camera, origin: np.ndarray) -> Camera:
    """The camera of a world whose origin is a point of ours; itself where that is our origin."""
    if not origin.any():
        return camera
    T_cam_world = camera.T_cam_world.copy()
    T_cam_world[:3, 3] += T_cam_world[:3, :3] @ origin
    return dataclasses.replace(camera, T_cam_world=T_cam_world)


def to_numpy(value: Any, dtype: type) -> np.ndarray:
    """A tensor of a `RenderOutput` as an array on the host."""
    return value.detach().cpu().numpy().astype(dtype, copy=False)


class PosedGaussians:
    """What the rasterizer reads of a posed scene, beside its colours.

    numpy computes it, like everything else of a frame before the kernels: torch would wake its threads for that, and
    they get in the way of ours.
    """

    def __init__(self, posed: PosedScene):
        self.means = tensor(posed.means)
        self.quats = tensor(posed.quats)
        self.scales = tensor(np.exp(posed.log_scales))
        with np.errstate(over="ignore"):
            self.opacities = tensor(1 / (1 + np.exp(-posed.opacity_logits)))
        self.object_ids = torch.from_numpy(np.ascontiguousarray(posed.object_ids))


def tensor(array: np.ndarray) -> torch.Tensor:
    """A float32 tensor of an array, which stays as it is."""
    array = np.ascontiguousarray(array, np.float32)
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _affine(matrix: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Linear part and translation of a [4, 4] matrix that can be undone."""
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"instance {index}: expected a finite matrix [4, 4], got {matrix!r}")
    singular = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if singular[-1] <= 1e-9 * max(singular[0], 1e-30):
        raise ValueError(f"instance {index}: the matrix flattens space (scale 0); hide the object instead")
    return matrix[:3, :3], matrix[:3, 3]


def _rows(given: Gathered, index: int, instance: Instance) -> tuple[int, int]:
    """First row of an instance among those gathered, and the one past its last."""
    if not 0 <= instance.scene < len(given.starts) - 1:
        raise ValueError(f"instance {index}: scene {instance.scene} of {len(given.starts) - 1} is not there")
    first, end = given.starts[instance.scene : instance.scene + 2]
    start, stop = instance.start, instance.start + instance.count
    if not 0 <= start <= stop <= end - first:
        raise ValueError(f"instance {index}: rows {start}:{stop} leave the scene's {end - first} Gaussians")
    return first + start, first + stop


def _tints(instances: Sequence[Instance]) -> np.ndarray | None:
    """Factors on the colours of each pose, the first of which nobody has; None where nothing is tinted. [P, 3]"""
    if all(instance.tint is None for instance in instances):
        return None
    tints = np.ones((1 + len(instances), 3), np.float32)
    for index, instance in enumerate(instances):
        if instance.tint is not None:
            tint = np.asarray(instance.tint, np.float64)
            if tint.shape != (3,) or not np.isfinite(tint).all() or (tint < 0).any():
                raise ValueError(f"instance {index}: expected a tint of three factors >= 0, got {instance.tint!r}")
            tints[1 + index] = tint
    return tints


def _take(array: np.ndarray, ranges: Sequence[tuple[int, int]]) -> np.ndarray:
    """Rows of ranges, one after the other; the array itself where they are all of it in order."""
    edges = [0, *(edge for start, stop in ranges for edge in (start, stop)), len(array)]
    if all(before == after for before, after in zip(edges[::2], edges[1::2], strict=True)):
        return array
    return np.concatenate([array[:0], *(array[start:stop] for start, stop in ranges)])


def _map_shapes(
    linear: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, new_quats: np.ndarray, new_log_scales: np.ndarray
) -> np.ndarray:
    """Write the shapes of ellipsoids under a linear map; returns the rotation nearest to the map. [3, 3]"""
    singular = np.linalg.svd(linear, compute_uv=False)
    nearest = _nearest_rotation(linear)
    uniform = singular[0] - singular[-1] <= SIMILARITY_TOLERANCE * singular[0]
    if uniform and np.linalg.det(linear) > 0:
        playback.turn_quats(quats, rotations.rotmats_to_quats(nearest), new_quats)
        np.add(log_scales, np.float32(np.log(singular.mean())), out=new_log_scales)
        return nearest
    axes = linear @ (rotations.quats_to_rotmats(np.asarray(quats, np.float64)) * np.exp(log_scales)[:, None, :])
    u, singular, _ = np.linalg.svd(axes)
    u[..., 2] *= np.sign(np.linalg.det(u))[:, None]
    new_quats[:], new_log_scales[:] = rotations.rotmats_to_quats(u), np.log(np.maximum(singular, 1e-30))
    return nearest


def _nearest_rotation(linear: np.ndarray) -> np.ndarray:
    """The rotation that is nearest to a linear map. [3, 3] -> [3, 3]"""
    u, _, vt = np.linalg.svd(linear)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def _shading(given: Gathered, rows: slice, rotation: np.ndarray, light: np.ndarray | None) -> np.ndarray:
    """Shading factor of a range that has turned by a rotation under a light. [n] float32"""
    if given.shading is None or given.shading_rest is None or light is None:
        return np.ones(rows.stop - rows.start, np.float32)
    change = (rotation.T @ light - light).astype(np.float32)
    return np.maximum(given.shading_rest[rows] + given.shading[rows] @ change, 0)

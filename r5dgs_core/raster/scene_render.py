"""A posed scene to a picture: the one place where evaluation, the worker and export turn Gaussians of a `Scene` into
pixels.

Colour of a Gaussian: max(0, 0.5 + SH(A^-1 d)) times max(0, shading factor) as in training, with d the viewing
direction in the world and A the map that brought the Gaussian from its bind state. Behind everything lies the scene's
sky, the spherical harmonics `Scene.background_sh` along each pixel's ray, within [0, 1] as in training.
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
        matrix: Affine map from the bind state to the world. [4, 4]
    """

    start: int
    count: int
    matrix: np.ndarray


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


def pose_instances(scene: Scene, instances: Sequence[Instance]) -> PosedScene:
    """Ranges of a scene's Gaussians, each moved by a matrix of its own.

    A range may appear several times, or not at all. Rotation, translation and uniform scale are exact in every respect;
    under any other linear map the ellipsoids are still mapped exactly and the viewing direction is brought back by the
    inverse. Shading turns with the rotation that is nearest to the map.

    Args:
        scene: The scene.
        instances: Ranges and their maps.

    Returns:
        The Gaussians, in the order of ``instances``.

    Raises:
        ValueError: A range leaves the scene, or a matrix flattens space or is not finite.
    """
    n, view_maps = len(scene.means), [np.eye(3)]
    ranges = [(instance.start, instance.start + instance.count) for instance in instances]
    for index, (start, stop) in enumerate(ranges):
        if not 0 <= start <= stop <= n:
            raise ValueError(f"instance {index}: rows {start}:{stop} leave the scene's {n} Gaussians")
    total = sum(instance.count for instance in instances)
    means, quats, log_scales = (np.empty((total, width), np.float32) for width in (3, 4, 3))
    shading, pose_ids = np.ones(total, np.float32), np.empty(total, np.int64)
    filled = 0
    for index, instance in enumerate(instances):
        linear, offset = _affine(instance.matrix, index)
        part, to = slice(*ranges[index]), slice(filled, filled + instance.count)
        playback.move_points(scene.means[part], linear, offset, means[to])
        rotation = _map_shapes(linear, scene.quats[part], scene.log_scales[part], quats[to], log_scales[to])
        shading[to] = _shading(scene, part, rotation)
        pose_ids[to] = len(view_maps)
        view_maps.append(np.linalg.inv(linear))
        filled = to.stop
    shaded = scene.shading is not None and scene.light_direction is not None
    return PosedScene(
        means=means,
        quats=quats,
        log_scales=log_scales,
        opacity_logits=_take(scene.opacity_logits, ranges),
        sh=_take(scene.sh, ranges),
        object_ids=_take(scene.object_ids, ranges),
        view_maps=np.stack(view_maps),
        pose_ids=pose_ids,
        shading_factor=shading if shaded else None,
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


def colors(posed: PosedScene, camera: Camera) -> np.ndarray:
    """Display-referred colour of every Gaussian as this camera sees it, >= 0. [N, 3] float32"""
    factor = posed.shading_factor
    if posed.sh.shape[1] == 1:
        rgb = np.maximum(spherical_harmonics.dc_to_rgb(np.asarray(posed.sh[:, 0], np.float32)), 0)
        if factor is not None:
            for channel in range(3):  # a column at a time: numpy is slow at rows of three
                rgb[:, channel] *= factor
        return rgb
    with torch.no_grad():
        seen = harmonics.seen_colors(
            tensor(posed.means),
            tensor(posed.sh),
            camera.center - posed.origin,
            view_maps=posed.view_maps,
            pose_ids=posed.pose_ids,
            factor=None if factor is None else tensor(factor),
        )
    return seen.numpy()


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
    u, singular, vt = np.linalg.svd(linear)
    nearest = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
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


def _shading(scene: Scene, rows: slice, rotation: np.ndarray) -> np.ndarray:
    """Shading factor of a range that has turned by a rotation. [n] float32"""
    if scene.shading is None or scene.light_direction is None:
        return np.ones(rows.stop - rows.start, np.float32)
    light = np.asarray(scene.light_direction, np.float64)
    change = (rotation.T @ light - light).astype(np.float32)
    return np.maximum(playback.rest_factors(scene)[rows] + scene.shading[rows] @ change, 0)

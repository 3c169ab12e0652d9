"""Workloads: cubes of random Gaussians, a generated garden, a moving table top, and scene files.

    python -m benchmarks.raster workloads [--workloads W1,W4] [--garden FILE]

prints statistics of each. Generated workloads are seeded and the same on every machine. The real garden is the file
assets/test_garden.npz of github.com/nerfstudio-project/gsplat, which may not be redistributed here.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.raster import RasterSettings
from r5dgs_core.render import posed_scene, scene_renderer
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.scene.scene import Scene

from . import tabletop

GARDEN = "W4garden"  # needs a file; all others are generated


@dataclass(frozen=True)
class Workload:
    """Gaussians in front of a camera.

    Attributes:
        name: As in the rows of results.
        inputs: means [N, 3], quats [N, 4], scales [N, 3], opacities [N] and channels [N, D], float32, as
            `rasterize_splats` takes them.
        camera: The view.
        settings: Of the rasterizer.
        scene: The scene that was posed, or None.
        t: Time at which it was posed.
    """

    name: str
    inputs: list[torch.Tensor]
    camera: Camera
    settings: RasterSettings = RasterSettings()
    scene: Scene | None = None
    t: float = 0.0

    @property
    def n_channels(self) -> int:
        """D, the number of channels."""
        return self.inputs[-1].shape[1]


def make(name: str, garden: Path | None = None) -> Workload:
    """The workload of this name.

    Args:
        name: A key of `GENERATED`, or "W4garden".
        garden: File for "W4garden".

    Raises:
        ValueError: The name is not known, or the file is missing or another one.
    """
    check(name, garden)
    return _real_garden(garden) if name == GARDEN and garden is not None else GENERATED[name](name)


def check(name: str, garden: Path | None = None) -> None:
    """Raise ValueError if `make` cannot create a workload of this name."""
    if name not in (*GENERATED, GARDEN):
        raise ValueError(f"workloads: expected of {', '.join([*GENERATED, GARDEN])}, got {name!r}")
    if name == GARDEN and (garden is None or not garden.is_file()):
        raise ValueError(f"workload {GARDEN}: expected --garden test_garden.npz (gsplat's), got {garden}; or use W4")


def pose_scene(name: str, scene: Scene, camera: Camera, t: float) -> Workload:
    """A scene at a time, drawn as playback poses it."""
    posed = posed_scene.pose_frame(scene, scene_player.Player(scene).frame(t))
    inputs = _tensors(
        posed.means,
        posed.quats,
        np.exp(posed.log_scales.astype(np.float64)),
        1 / (1 + np.exp(-posed.opacity_logits.astype(np.float64))),
        scene_renderer.colors(posed, camera),
    )
    return Workload(name, inputs, camera, RasterSettings(near_plane=scene.near_plane), scene, t)


def find_camera(scene: Scene, name: str) -> Camera:
    """Camera of a scene by name, or by its number from 0. Raises ValueError if it does not exist."""
    by_name = {camera.name: camera for camera in scene.cameras}
    if name in by_name:
        return by_name[name]
    if name.isdecimal() and int(name) < len(scene.cameras):
        return scene.cameras[int(name)]
    known = ", ".join(by_name) or "none"
    raise ValueError(f"camera: expected a name or a number below {len(scene.cameras)}, got {name!r}; names: {known}")


def look_at(eye: Iterable[float], target: Iterable[float], up: Iterable[float]) -> np.ndarray:
    """World to camera (OpenCV axes) for a camera at ``eye`` that looks at ``target``. [4, 4]"""
    eye = np.asarray(eye, np.float64)
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(-np.asarray(up, np.float64), forward)
    right /= np.linalg.norm(right)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T_cam_world[:3, 3] = -T_cam_world[:3, :3] @ eye
    return T_cam_world


def pinhole(width: int, height: int, focal: float) -> np.ndarray:
    """Intrinsics with the principal point in the middle, focal length in px. [3, 3]"""
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def _cube(count: int, width: int, height: int, n_channels: int, radius_px: float = 4.0) -> Callable[[str], Workload]:
    """Centres uniform in the cube [-1, 1]^3, log-normal sizes and anisotropy, opacities and channels uniform.

    Args:
        count: Number of Gaussians.
        width: Of the image, px; spans 50 degrees.
        height: Of the image, px.
        n_channels: Channels to blend.
        radius_px: Median of three standard deviations along the longest axis, px.
    """

    def build(name: str) -> Workload:
        random = np.random.default_rng(0)
        means = random.uniform(-1, 1, (count, 3))
        quats = _unit(random.normal(size=(count, 4)))
        scales = np.exp(0.5 * random.normal(size=(count, 1)) + 0.5 * random.normal(size=(count, 3)))
        focal = 0.5 * width / math.tan(math.radians(25.0))
        T_cam_world = look_at((0.5, -0.4, -3.0), (0, 0, 0), up=(0, -1, 0))
        depths = means @ T_cam_world[2, :3] + T_cam_world[2, 3]
        scales *= radius_px / 3 / np.median(scales.max(1) * focal / depths)
        opacities = random.uniform(0.1, 0.99, count)
        channels = random.uniform(0, 1, (count, n_channels))
        camera = Camera(width, height, pinhole(width, height, focal), T_cam_world, name)
        return Workload(name, _tensors(means, quats, scales, opacities, channels), camera)

    return build


def _real_garden(path: Path) -> Workload:
    """Points, colours and first camera of gsplat's test file, 400 px wide; sizes from neighbours, the rest random."""
    from scipy.spatial import cKDTree

    with np.load(path) as file:
        missing = [key for key in ("means3d", "colors", "Ks", "viewmats", "width", "height") if key not in file.files]
        if missing:
            raise ValueError(f"{path}: expected gsplat's test_garden.npz, found no {', '.join(missing)}")
        means = file["means3d"].astype(np.float64)
        colors = file["colors"] / 255.0
        intrinsics, T_cam_world = file["Ks"][0].astype(np.float64), file["viewmats"][0].astype(np.float64)
        width, height = int(file["width"]), int(file["height"])
    factor = 400 / width
    intrinsics[:2] *= factor
    random = np.random.default_rng(0)
    distances, _ = cKDTree(means).query(means, k=4)
    spacing = np.sqrt((distances[:, 1:] ** 2).mean(1, keepdims=True))
    spacing = np.clip(spacing, np.quantile(spacing, 0.01), np.quantile(spacing, 0.99))
    scales = spacing * np.exp(0.4 * random.normal(size=(len(means), 3)))
    quats = _unit(random.normal(size=(len(means), 4)))
    opacities = random.uniform(0.1, 0.99, len(means))
    camera = Camera(400, round(height * factor), intrinsics, T_cam_world, GARDEN)
    return Workload(GARDEN, _tensors(means, quats, scales, opacities, colors), camera)


def _garden(name: str) -> Workload:
    """Generated garden with the load of "W4garden": a table on gravel amid a lawn, within a ring of hedges.

    Sizes are log-normal around a median that grows with the distance from the table, as the spacing of triangulated
    points does. Numbers were chosen so that the statistics of `describe` agree with those of the real points.
    """
    random = np.random.default_rng(0)
    parts = [
        _disc(random, 14_000, radius=0.55, height=0.42, thickness=0.012, color=(0.45, 0.38, 0.32), size=0.0068),
        _ball(random, 7_000, radius=0.14, center=(0.0, 0.0, 0.58), color=(0.60, 0.35, 0.20), size=0.0060),
        _ring(random, 4_000, 0.02, 0.35, low=0.0, high=0.42, color=(0.40, 0.30, 0.22), size=0.0070),
        _ring(random, 45_000, 0.0, 1.3, low=-0.01, high=0.02, color=(0.55, 0.50, 0.45), size=0.0084),
        _ring(random, 11_000, 1.1, 2.8, low=0.0, high=0.06, color=(0.30, 0.45, 0.15), size=0.0150),
        _ring(random, 57_000, 2.4, 3.4, low=0.0, high=1.9, color=(0.20, 0.35, 0.12), size=0.0260),
        _ring(random, 766, 3.4, 9.0, low=0.3, high=3.5, color=(0.35, 0.40, 0.42), size=0.0500),
    ]
    means, colors, scales = (np.concatenate(column) for column in zip(*parts, strict=True))
    n = len(means)
    scales = scales * np.exp(0.4 * random.normal(size=(n, 3)))
    quats = _unit(random.normal(size=(n, 4)))
    opacities = random.uniform(0.1, 0.99, n)
    T_cam_world = look_at((-1.7, 0.0, 1.0), (0.0, 0.0, 0.58), up=(0, 0, 1))
    camera = Camera(400, 259, pinhole(400, 259, 297.0), T_cam_world, name)
    return Workload(name, _tensors(means, quats, scales, opacities, colors), camera)


def _tabletop(count: int, size: int) -> Callable[[str], Workload]:
    """The table top past t_max, at a time at which all bodies have moved and rotated."""

    def build(name: str) -> Workload:
        T_cam_world = look_at((0.35, -2.6, 1.5), (0, 0, 0.25), up=(0, 0, 1))
        camera = Camera(size, size, pinhole(size, size, 1.1 * size), T_cam_world, name)
        return pose_scene(name, tabletop.build(count, camera), camera, tabletop.T_MAX + 0.2)

    return build


def _ring(random, count, inner, outer, low, high, color, size):
    """Centres, colours and sizes of a ring about the vertical axis, uniform over its area and height."""
    angle = random.uniform(0, 2 * np.pi, count)
    radius = np.sqrt(random.uniform(inner**2, outer**2, count))
    means = np.stack([radius * np.cos(angle), radius * np.sin(angle), random.uniform(low, high, count)], 1)
    return means, _colors(random, count, color), _sizes(random, count, size)


def _disc(random, count, radius, height, thickness, color, size):
    """A flat disc: most Gaussians of a table top."""
    return _ring(random, count, 0.0, radius, height - thickness, height + thickness, color, size)


def _ball(random, count, radius, center, color, size):
    """A rough sphere's surface."""
    directions = _unit(random.normal(size=(count, 3)))
    means = np.asarray(center) + radius * random.uniform(0.8, 1.1, (count, 1)) * directions
    return means, _colors(random, count, color), _sizes(random, count, size)


def _sizes(random, count, median):
    return median * np.exp(0.46 * random.normal(size=(count, 1)))


def _colors(random, count, color):
    return np.clip(np.asarray(color) + 0.12 * random.normal(size=(count, 3)), 0, 1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.tensor(array, dtype=torch.float32) for array in arrays]


GENERATED: dict[str, Callable[[str], Workload]] = {
    "train": _cube(12_000, 128, 128, 3),  # a training step of the demo
    "train+16": _cube(12_000, 128, 128, 19),  # the same with identity encodings
    "W0": _cube(600, 48, 40, 5, radius_px=7.0),  # small enough for every oracle
    "W1": _cube(40_000, 400, 400, 3),
    "W1h": _cube(40_000, 400, 400, 3, radius_px=12.0),  # heavy overlap
    "W2": _cube(40_000, 400, 400, 19),  # colour and identity encodings
    "W3": _cube(200_000, 800, 800, 3),
    "W4": _garden,
    "tabletop": _tabletop(40_000, 400),
    "tabletop-small": _tabletop(12_000, 200),
}


def describe(workload: Workload) -> dict[str, float]:
    """Return statistics of a workload.

    Returns:
        ``gaussians`` and how many of them are ``visible_clouds`` (their alpha_min ellipse's box meets the image); three
        standard deviations along the long axis of those, px: ``radius_median`` and ``radius_p95``; ``tile_pairs``:
        boxes times tiles of 16 x 16 px; ``pairs``: contributions of at least alpha_min to pixels that are not yet
        finished; ``pairs_per_px``; ``finished``: share of the pixels that stop early.
    """
    camera, settings = workload.camera, workload.settings
    opacity = workload.inputs[3].double().numpy()
    centers, a, b, c, z = _project(workload)
    reach = 2 * np.log(np.maximum(opacity / settings.alpha_min, 1))
    extent = np.sqrt(reach[:, None] * np.stack([a, c], 1))
    size = np.array([camera.width, camera.height])
    seen = (z > settings.near_plane) & (reach > 0)
    seen &= ((centers + extent > 0) & (centers - extent < size)).all(1)
    radii = 3 * np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b))[seen]
    low = np.maximum(np.ceil(centers - extent - 0.5), 0)
    high = np.minimum(np.floor(centers + extent - 0.5), size - 1)  # first and last pixel whose centre is inside
    drawn = seen & (low <= high).all(1)
    low[~drawn], high[~drawn] = 0, 0
    low, high = low.astype(np.int64), high.astype(np.int64)
    tiles = np.where(drawn, (high // 16 - low // 16 + 1).prod(1), 0)

    determinant = a * c - b * b
    passed, finished, pairs = np.ones((camera.height, camera.width)), np.zeros((camera.height, camera.width), bool), 0
    order = np.flatnonzero(drawn)
    for i in order[np.argsort(z[order], kind="stable")]:
        part = (slice(low[i, 1], high[i, 1] + 1), slice(low[i, 0], high[i, 0] + 1))
        dx = np.arange(low[i, 0], high[i, 0] + 1) + 0.5 - centers[i, 0]
        dy = (np.arange(low[i, 1], high[i, 1] + 1) + 0.5 - centers[i, 1])[:, None]
        square = (c[i] * dx * dx - 2 * b[i] * dx * dy + a[i] * dy * dy) / determinant[i]
        alpha = np.minimum(opacity[i] * np.exp(-0.5 * square), settings.alpha_max)
        touched = (alpha >= settings.alpha_min) & ~finished[part]
        after = passed[part] * (1 - alpha)
        stops = touched & (after < settings.finished_at)
        finished[part] |= stops
        passed[part] = np.where(touched & ~stops, after, passed[part])
        pairs += int((touched & ~stops).sum())
    return {
        "gaussians": len(centers),
        "visible": int(seen.sum()),
        "radius_median": float(np.median(radii)) if len(radii) else 0.0,
        "radius_p95": float(np.quantile(radii, 0.95)) if len(radii) else 0.0,
        "tile_pairs": int(tiles.sum()),
        "pairs": pairs,
        "pairs_per_px": pairs / finished.size,
        "finished": float(finished.mean()),
    }


def _project(workload: Workload) -> tuple[np.ndarray, ...]:
    """Centres in px [N, 2], entries xx, xy and yy of the covariances with dilation in px^2 [N], depths [N]; float64."""
    means, quats, scales = (tensor.double().numpy() for tensor in workload.inputs[:3])
    camera, settings = workload.camera, workload.settings
    rotation, k = camera.T_cam_world[:3, :3], camera.intrinsics
    p_cam = means @ rotation.T + camera.T_cam_world[:3, 3]
    z = np.where(p_cam[:, 2] > settings.near_plane, p_cam[:, 2], 1.0)
    focal, middle = np.diag(k)[:2], k[:2, 2]
    slopes = p_cam[:, :2] / z[:, None]
    size = np.array([camera.width, camera.height])
    slack = settings.frustum_slack * 0.5 * size / focal
    clamped = slopes.clip(-middle / focal - slack, (size - middle) / focal + slack)
    axes = rotation @ rotations.quats_to_rotmats(_unit(quats)) * scales[:, None, :]
    x, y = (focal[i] / z[:, None] * (axes[:, i] - clamped[:, i : i + 1] * axes[:, 2]) for i in range(2))
    xx, xy, yy = (x * x).sum(1) + settings.dilation, (x * y).sum(1), (y * y).sum(1) + settings.dilation
    return focal * slopes + middle, xx, xy, yy, p_cam[:, 2]


def name_list(text: str) -> list[str]:
    """Names between commas, for `argparse`."""
    return [name.strip() for name in text.split(",") if name.strip()]


def number_list(text: str) -> list[int]:
    """Whole numbers between commas, for `argparse`."""
    return [int(number) for number in name_list(text)]


def main(arguments: list[str] | None = None) -> None:
    """Print statistics of the workloads."""
    parser = argparse.ArgumentParser(description="Print statistics of the workloads.")
    parser.add_argument("--workloads", type=name_list, nargs="+", default=[["W0", "W1", "W1h", "W2", "W3", "W4"]])
    parser.add_argument("--garden", type=Path, help=f"gsplat's test_garden.npz: adds {GARDEN}")
    options = parser.parse_args(arguments)
    names = [name for part in options.workloads for name in part] + ([GARDEN] if options.garden else [])
    for i, name in enumerate(dict.fromkeys(names)):
        try:
            figures = describe(make(name, options.garden))
        except (ValueError, OSError) as error:
            parser.error(str(error))
        if i == 0:
            print(" ".join(f"{key:>14}" for key in ("workload", *figures)))
        print(" ".join(f"{x:>14}" for x in (name, *(round(value, 2) for value in figures.values()))), flush=True)


if __name__ == "__main__":
    main()

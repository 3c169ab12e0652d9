"""Stability cases on code around motion: scene files, keys, cameras and the rasterizer.

Each case must finish within `cases.MAX_SECONDS` of processor time.
"""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import numpy as np

from ..motion import key_reduction, models
from ..scene import cameras, scene_file
from ..scene.cameras import Camera
from .cases import Case, body, largest, model_of
from .scenes import T_MAX, scene_of

_FRAME = 1 / 60
_BOUNDED = "a constant times the number of frames"
_ROUNDING = "rounding of float32"


def _round_trip(bodies: int, scale: float, times: np.ndarray) -> float:
    """Largest error of a centre after writing and reading a scene, relative to its extent."""
    cloud = scale * body(0.3)
    clouds = [cloud + scale * np.array([k % 100, k // 100, 0.0]) for k in range(bodies)]
    motion = model_of("ballistic_spin", angular_velocity=[0, 0, 1e5], velocity=[scale, 0, 0])
    scene = scene_of(clouds, [motion] * bodies, times=times)
    with tempfile.TemporaryDirectory() as folder:
        found = scene_file.read(scene_file.write(scene, Path(folder) / "s.r5dgs"))
    return largest(found.gaussians.means.astype(np.float64) - scene.gaussians.means) / scene.extent


def _many_knots() -> float:
    return _round_trip(1, 1.0, np.linspace(0.0, 1.0, 20_000))


_WILD = {
    "a twist of 1e4 rad per unit that tilts": model_of(
        "world_twist", velocity=[1, 0, 0], angular_velocity=[1e4, 0, 2], angular_acceleration=[0, 1.5, 0]
    ),
    "an orbit of 1e15 units per unit": model_of(
        "world_twist", velocity=[1e15, 0, 0], angular_velocity=[1, 0, 2], angular_acceleration=[0, 9, 0]
    ),
    "a top of 1e6 rad per unit": model_of("free_top", angular_velocity=[1e6, 3e5, 0]),
    "a swing of 1e6 rad per unit": model_of("translation", velocity=[1e3, 0, 0], frequency=1e6),
    "an offset that jumps": model_of("translation", offset_displacement=[1, 0, 0], fade_time=1e-300),
}


def _keys(model: models.MotionModel, frame: float) -> float:
    """Number of samples over its bound, for ten units of time; infinity if keys are not finite."""
    sampled, sample = [0], key_reduction.model_sampler(model, T_MAX)

    def counted(times: np.ndarray) -> key_reduction.Samples:
        sampled[0] += len(times)
        return sample(times)

    frames = key_reduction.FrameTimes(0.0, frame)
    curves = key_reduction.reduce(counted, T_MAX, T_MAX + 10, 1e-6, 0.3, nearest=0.011 * frame, frames=frames)
    values = [curves.location.values, curves.rotation.values]
    if not all(np.isfinite(part).all() for part in values):
        return float("inf")
    return sampled[0] / (40 * min(max(10 / frame, key_reduction.MIN_INTERVALS), key_reduction.MAX_INTERVALS))


def _looking(distance: float = 4.0) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = [0.1 * distance, 0.05 * distance, distance]
    return Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), pose)


def _axes(scale: float) -> float:
    """Largest error of a pose converted to OpenGL's axes and back, relative to its distance."""
    pose = _looking(scale).T_cam_world
    back = cameras.opengl_to_cam_world(cameras.cam_world_to_opengl(pose))
    return float(np.abs(back - pose).max() / max(scale, 1.0))


def _projected(scale: float) -> float:
    """Largest difference of a projected point, in pixels, between a world and its scaled copy."""
    one, other = (cameras.project(_looking(4 * s), s * body())[0] for s in (1.0, scale))
    return float(np.abs(one - other).max())


def _picture(scale: float, shape: tuple[float, float, float] = (0.1, 0.1, 0.1), at: float = 0.0) -> np.ndarray:
    import torch

    from ..raster import rasterize_splats

    means = scale * body() + at * np.array([0.0, 0.0, 1.0])
    count = len(means)
    turns = np.random.default_rng(0).normal(size=(count, 4))
    scales = np.tile(scale * np.array(shape), (count, 1))
    channels = np.eye(count)[:, :3]
    floats = [torch.tensor(each, dtype=torch.float32) for each in (means, turns, scales, np.full(count, 0.7), channels)]
    drawn = rasterize_splats(floats[0], floats[1], floats[2], floats[3], floats[4], _looking(4 * scale))
    return drawn.image.numpy()


def _drawn(scale: float) -> float:
    """Largest difference of a pixel between a world and its copy of unit size."""
    return float(np.abs(_picture(scale) - _picture(1.0)).max())


def _finite(shape: tuple[float, float, float], at: float = 0.0) -> float:
    return float((~np.isfinite(_picture(1.0, shape, at))).sum())


def _warm() -> None:
    """Compile the kernels before the timed part of a case."""
    from ..render import warm_up

    warm_up.warm_up(gradients=False)


CASES: tuple[Case, ...] = (
    *(
        Case(
            "loading",
            name,
            "scene.scene_file.write, scene.scene_file.read",
            "error of a centre / extent",
            1e-4,
            "16 bits of a position",
            measure,
        )
        for name, measure in (
            ("a world of 1e-6 units", functools.partial(_round_trip, 1, 1e-6, np.linspace(0, 1, 5))),
            ("a world of 1e6 units", functools.partial(_round_trip, 1, 1e6, np.linspace(0, 1, 5))),
            ("times of 1e6 units", functools.partial(_round_trip, 1, 1.0, np.linspace(0, 1e6, 5))),
            ("1000 bodies", functools.partial(_round_trip, 1000, 1.0, np.linspace(0, 1, 5))),
            ("20,000 knots", _many_knots),
        )
    ),
    *(
        Case(
            "keying",
            f"{name}, {label}",
            "motion.key_reduction.reduce",
            "samples / bound",
            1.0,
            _BOUNDED,
            functools.partial(_keys, model, frame),
        )
        for name, model in _WILD.items()
        for label, frame in (("600 frames", _FRAME), ("1e7 frames", 1e-6), ("1e-5 frames", 1e6))
    ),
    *(
        Case("cameras", f"{what}, {scale:g}", method, quantity, limit, source, functools.partial(measure, scale))
        for what, method, quantity, limit, source, measure in (
            (
                "to OpenGL and back, distance",
                "scene.cameras.cam_world_to_opengl, scene.cameras.opengl_to_cam_world",
                "error / distance",
                1e-12,
                "rounding of float64",
                _axes,
            ),
            ("projection, world of size", "scene.cameras.project", "pixels", 1e-9, "rounding of float64", _projected),
        )
        for scale in (1e-12, 1e-6, 1e6, 1e12)
    ),
    *(
        Case(
            "rasterizer",
            f"a world of size {scale:g}",
            "raster.rasterize_splats",
            "largest difference of a pixel",
            2e-3,
            _ROUNDING,
            functools.partial(_drawn, scale),
            prepare=_warm,
        )
        for scale in (0.1, 10.0, 1e3, 1e6)
    ),
    *(
        Case(
            "rasterizer",
            name,
            "raster.rasterize_splats",
            "pixels that are not finite",
            0.0,
            "all finite",
            functools.partial(_finite, *arguments),
            prepare=_warm,
        )
        for name, *arguments in (
            ("needles, 1e-6 to 1e3", (1e-6, 1e-6, 1e3)),
            ("Gaussians of 1e6 units", (1e6, 1e6, 1e6)),
            ("Gaussians of 1e-12 units", (1e-12, 1e-12, 1e-12)),
            ("Gaussians around the camera", (1.0, 1.0, 1.0), -4.0),
        )
    ),
)

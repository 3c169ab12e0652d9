"""Rendering speed of this machine, measured on a synthetic picture."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from .. import timing
from ..raster import backends, rasterize_splats
from ..scene.cameras import Camera
from . import warm_up

GAUSSIANS = 20_000
SIZE = 400
REPEATS = 7


@dataclass(frozen=True)
class SpeedTestResult:
    """Result of a speed test.

    Attributes:
        milliseconds: Median time per picture.
        gaussians: Number of Gaussians.
        size: Width and height in pixels.
        device: Description of the device.
    """

    milliseconds: float
    gaussians: int
    size: tuple[int, int]
    device: str


def run() -> SpeedTestResult:
    """Time the rasterization of a ball of Gaussians, after compilation."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(GAUSSIANS, 3))
    means = (
        directions / np.linalg.norm(directions, axis=1, keepdims=True) * np.cbrt(random.uniform(size=(GAUSSIANS, 1)))
    )
    scales = 0.015 * np.exp(0.5 * random.normal(size=(GAUSSIANS, 3)))
    quats, colors = (random.uniform(0.1, 0.9, (GAUSSIANS, width)) for width in (4, 3))
    places, axes, turns, values = (a.astype(np.float32) for a in (means, scales, quats, colors))
    opacities = random.uniform(0.1, 0.9, GAUSSIANS).astype(np.float32)
    T_cam_world = np.eye(4)
    T_cam_world[2, 3] = 3.0
    half = SIZE / 2
    camera = Camera(SIZE, SIZE, np.array([[2.2 * half, 0, half], [0, 2.2 * half, half], [0, 0, 1]]), T_cam_world)
    warm_up.warm_up(gradients=False)
    draw = functools.partial(rasterize_splats, places, turns, axes, opacities, values, camera)
    times = timing.take({"picture": draw}, REPEATS)["picture"]
    hardware = backends.choose("auto", places).hardware()
    return SpeedTestResult(times.ms(), GAUSSIANS, (SIZE, SIZE), hardware)

"""Stiff and extreme scenes for the rasterizer, for the benchmark `extreme` and the tests.

Cameras look along +z from the origin unless stated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from r5dgs_core.raster import RasterSettings
from r5dgs_core.scene.cameras import Camera


@dataclass(frozen=True)
class Case:
    """A difficult scene.

    Attributes:
        inputs: Means, quats, scales, opacities, channels, float32.
        camera: The view.
        gives: Expected picture, for the docs.
        background: Background for `rasterize_splats`.
        settings: Settings for `rasterize_splats`.
    """

    inputs: list[torch.Tensor]
    camera: Camera
    gives: str
    background: torch.Tensor | None = None
    settings: RasterSettings = field(default_factory=RasterSettings)


CASES: dict[str, Callable[[], Case]] = {}


def case(name: str) -> Callable[[Callable[[], Case]], Callable[[], Case]]:
    """Register the function below under a name."""
    return lambda make: CASES.setdefault(name, make)


def view(width: int = 48, height: int = 40, focal: float = 50.0, T_cam_world: np.ndarray | None = None) -> Camera:
    """A camera with the optical axis through the middle of the image."""
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(width, height, intrinsics, np.eye(4) if T_cam_world is None else T_cam_world)


def cloud(n: int = 200, n_channels: int = 3, seed: int = 0, sigma: float = 0.05) -> list[torch.Tensor]:
    """Random Gaussians in a box two to four units in front of the camera."""
    random = np.random.default_rng(seed)
    values = (
        random.uniform([-1, -0.8, 2], [1, 0.8, 4], (n, 3)),
        random.normal(size=(n, 4)),
        sigma * np.exp(0.5 * random.normal(size=(n, 3))),
        random.uniform(0.05, 0.9, n),
        random.uniform(0, 1, (n, n_channels)),
    )
    return [torch.tensor(v, dtype=torch.float32) for v in values]


def ulp(value: float, steps: int) -> float:
    """A float32 so many steps above or below ``value``."""
    result = np.float32(value)
    for _ in range(abs(steps)):
        result = np.nextafter(result, np.float32(math.copysign(math.inf, steps)))
    return float(result)


def on_pixels(view: Camera, n: int, z: float = 2.0) -> torch.Tensor:
    """Means at depth z that project to the centres of pixels, exactly for a focal length and z that are powers of 2."""
    i = torch.arange(n)
    x, y = (i * 5) % view.width + 0.5 - view.width / 2, (i * 5) // view.width * 5 % view.height + 0.5 - view.height / 2
    return torch.stack([x * z / view.intrinsics[0, 0], y * z / view.intrinsics[1, 1], torch.full((n,), z)], 1).float()


@case("one Gaussian covers a 4K image")
def one_gaussian_covers_a_4k_image() -> Case:
    scene = cloud(1)
    scene[0][0], scene[2][0], scene[3][0] = torch.tensor([0.2, -0.1, 3.0]), torch.tensor([2.0, 3.0, 1.0]), 0.8
    return Case(scene, view(3840, 2160, 3000.0), "its falloff over all 8.3 million pixels")


@case("scales from 1e-12 to 1e6")
def scales_from_1e_12_to_1e6() -> Case:
    scene = cloud(76, seed=1)
    sizes = torch.logspace(-12, 6, 19).repeat(4)
    stretch = torch.tensor([[1, 1, 1], [1, 0.3, 1], [1, 1, 0.01], [0.1, 1, 1.0]]).repeat_interleave(19, 0)
    scene[2] = sizes[:, None] * stretch
    scene[3] = torch.where(sizes > 0.5, 0.1, scene[3])
    return Case(scene, view(), "the small ones as dots of the dilation, the large ones as veils")


@case("every scale in one Gaussian")
def every_scale_in_one_gaussian() -> Case:
    scene = cloud(40, seed=2)
    scene[2] = torch.tensor([1e-12, 1e-3, 1e6]).expand(40, 3).clone()
    scene[3] *= 0.3
    return Case(scene, view(), "bands across the image")


@case("needles of condition 1e8")
def needles_of_condition_1e8() -> Case:
    scene = cloud(60, seed=3)
    length = torch.logspace(-1, 3, 60)
    scene[2] = torch.stack([length, 1e-8 * length, 1e-8 * length], 1)
    return Case(scene, view(), "lines as wide as the dilation")


@case("pancakes of condition 1e8")
def pancakes_of_condition_1e8() -> Case:
    scene = cloud(60, seed=4)
    length = torch.logspace(-1, 3, 60)
    scene[2] = torch.stack([length, length, 1e-8 * length], 1)
    scene[3] *= 0.3
    return Case(scene, view(), "ellipses, and lines where seen edge-on")


@case("needles whose centres are far off the image")
def needles_whose_centres_are_far_off_the_image() -> Case:
    scene = cloud(60, seed=5)
    along = torch.nn.functional.normalize(torch.cat([torch.randn(60, 2, generator=_seed(5)), torch.zeros(60, 1)], 1))
    distance = torch.logspace(0, 4, 60)
    scene[0] = scene[0] + along * distance[:, None]
    half = torch.atan2(along[:, 1], along[:, 0]) / 2
    scene[1] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
    scene[2] = torch.stack([distance, torch.full((60,), 1e-4), torch.full((60,), 1e-4)], 1)
    return Case(scene, view(), "their ends, where the centre may be 10^5 px away")


@case("needles through an image 3840 px wide")
def needles_through_an_image_3840_px_wide() -> Case:
    scene = cloud(3, seed=6)
    scene[0] = torch.tensor([[0.0, 0, 3], [1, 0.01, 3], [-0.5, 0.02, 4]])
    half = torch.tensor([0.03, -0.015, 0.6])
    scene[1] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], 1)
    scene[2] = torch.tensor([2.0, 1e-5, 1e-5]).expand(3, 3).clone()
    return Case(scene, view(3840, 200, 3000.0), "lines through thousands of pixels")


@case("centres at the near plane")
def centres_at_the_near_plane() -> Case:
    near = 0.5
    depths = [ulp(near, -1), near, ulp(near, 1), ulp(near, 2), 0.0, -1.0, -near, 0.6]
    scene = cloud(len(depths), seed=7)
    scene[0] = torch.stack([torch.linspace(-0.2, 0.2, len(depths)), torch.zeros(len(depths)), torch.tensor(depths)], 1)
    return Case(scene, view(), "those beyond it, from one step of float32 on", settings=RasterSettings(near_plane=near))


@case("centres at the default near plane")
def centres_at_the_default_near_plane() -> Case:
    near = RasterSettings().near_plane
    depths = [ulp(near, k) for k in range(-3, 6)] + [0.0, 1e-30, -1e-30]
    scene = cloud(len(depths), seed=8, sigma=1e-4)
    scene[0] = torch.stack(
        [torch.linspace(-4e-3, 4e-3, len(depths)), torch.zeros(len(depths)), torch.tensor(depths)], 1
    )
    return Case(scene, view(), "those beyond 0.01, compared in float64")


@case("camera inside Gaussians")
def camera_inside_gaussians() -> Case:
    scene = cloud(30, seed=9)
    scene[0][:10] = 0
    scene[0][10:20] = torch.tensor([[0.003, -0.002, 0.0101]]) * torch.linspace(1, 30, 10)[:, None]
    scene[2][:20] = torch.logspace(-2, 1, 20)[:, None] * torch.tensor([1, 0.5, 2])
    scene[3][:20] = 0.3
    return Case(scene, view(), "veils of those whose centre lies before the camera")


@case("opacities at their limits")
def opacities_at_their_limits() -> Case:
    settings = RasterSettings()
    values = [0.0, 1e-45, 1e-30]
    values += [ulp(limit, k) for limit in (settings.alpha_min, settings.alpha_max) for k in range(-3, 4)]
    values += [ulp(1.0, -1), 1.0]
    camera = view(focal=64.0)
    scene = cloud(len(values), seed=10, sigma=0.03)
    scene[0] = on_pixels(camera, len(values))
    scene[3] = torch.tensor(values)
    return Case(scene, camera, "0 is invisible, 1 is capped at 0.99, 1/255 is visible in one pixel")


@case("ten thousand opaque layers")
def ten_thousand_opaque_layers() -> Case:
    scene = cloud(10_000, seed=11)
    scene[0] = torch.tensor([0.0, 0, 2]) + torch.linspace(0, 1, 10_000)[:, None] * torch.tensor([0.0, 0, 1])
    scene[2][:], scene[3][:] = torch.tensor([0.5, 0.4, 0.3]), 1.0
    return Case(scene, view(1, 1), "only the nearest: a second would leave 1e-4", torch.tensor([0.2, 0.9, 0.4]))


@case("ten thousand thin layers")
def ten_thousand_thin_layers() -> Case:
    scene = cloud(10_000, seed=12)
    scene[0] = torch.tensor([0.01, 0, 2]) + torch.linspace(0, 1, 10_000)[:, None] * torch.tensor([0.0, 0, 1])
    scene[2][:], scene[3][:] = torch.tensor([0.5, 0.4, 0.3]), 0.004
    return Case(scene, view(1, 1), "the nearest 2,298", torch.tensor([0.2, 0.9, 0.4]))


@case("half transparent layers")
def half_transparent_layers() -> Case:
    scene = cloud(64, seed=13)
    scene[0] = torch.tensor([0.0, 0, 2]) + torch.arange(64)[:, None] * torch.tensor([0.0, 0, 0.125])
    scene[2][:] = torch.tensor([2e3, 1e3, 1.5e3])
    scene[3][:] = torch.tensor([0.5, 0.75, 0.875, 0.5])[torch.arange(64) % 4]
    settings = RasterSettings(transmittance_min=2.0**-13)
    gives = "all before the one that would bring transmittance to the minimum exactly"
    return Case(scene, view(9, 7), gives, settings=settings)


@case("coordinates 1e6 from the origin")
def coordinates_1e6_from_the_origin() -> Case:
    scene = cloud(200, seed=14, sigma=1.0)
    far = torch.tensor([1e6, -1e6, 1e6])
    scene[0] = scene[0] * 20 + far
    T_cam_world = np.eye(4)
    angle = 0.1
    T_cam_world[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_cam_world[:3, 3] = -T_cam_world[:3, :3] @ far.double().numpy()
    return Case(scene, view(T_cam_world=T_cam_world), "positions in steps of 1/16, the spacing of float32")


@case("no Gaussians")
def no_gaussians() -> Case:
    return Case(cloud(0), view(), "the background", torch.tensor([0.1, 0.2, 0.3]))


@case("a one pixel image")
def a_one_pixel_image() -> Case:
    return Case(cloud(100, seed=15, sigma=0.3), view(1, 1, 2.0), "one pixel", torch.rand(1, 1, 3, generator=_seed(1)))


@case("an image 16384 px wide and 8 high")
def an_image_16384_px_wide_and_8_high() -> Case:
    scene = cloud(100, seed=16)
    scene[0][:, :2] *= torch.tensor([3.0, 0.002])
    return Case(scene, view(16384, 8, 8000.0), "as any other")


@case("an image 8 px wide and 16384 high")
def an_image_8_px_wide_and_16384_high() -> Case:
    scene = cloud(100, seed=17)
    scene[0][:, :2] *= torch.tensor([0.002, 3.0])
    return Case(scene, view(8, 16384, 8000.0), "as any other")


@case("an image of 4096 by 4096 px")
def an_image_of_4096_by_4096_px() -> Case:
    return Case(cloud(10, 1, seed=18, sigma=0.01), view(4096, 4096, 3000.0), "as any other")


@case("duplicates at one place")
def duplicates_at_one_place() -> Case:
    scene = cloud(200, seed=19)
    for k in range(0, 200, 4):
        for values in scene[:3]:
            values[k : k + 4] = values[k].clone()
    shuffled = torch.randperm(200, generator=_seed(19))
    return Case([values[shuffled] for values in scene], view(), "the lower row in front")


@case("depths that differ less than float32 can")
def depths_that_differ_less_than_float32_can() -> Case:
    scene = cloud(200, seed=20, sigma=0.2)
    scene[0][:, 2] = 1e-6 * torch.arange(200).flip(0)
    scene[0][:, :2] *= 0.5
    T_cam_world = np.eye(4)
    T_cam_world[2, 3] = 100.0
    return Case(scene, view(focal=1500.0, T_cam_world=T_cam_world), "the nearer in front, sorted in float64")


@case("quaternions of length 1e-30 to 1e30")
def quaternions_of_length_1e_30_to_1e30() -> Case:
    scene = cloud(61, seed=21, sigma=0.1)
    scene[1] = torch.nn.functional.normalize(scene[1]) * torch.logspace(-30, 30, 61)[:, None]
    scene[1][:1] = 0
    return Case(scene, view(), "unit ones; zero is no rotation")


@case("means as far as 1e30")
def means_as_far_as_1e30() -> Case:
    scene = cloud(90, seed=22)
    distance = torch.logspace(0, 30, 90)
    scene[0] *= distance[:, None]
    scene[2] *= distance[:, None]
    return Case(scene, view(), "far Gaussians look like near ones of the same apparent size")


@case("means far off to the side")
def means_far_off_to_the_side() -> Case:
    scene = cloud(90, seed=23)
    scene[0][::2, 0] *= torch.logspace(0, 38, 45)
    scene[0][1::2, 1] *= -torch.logspace(0, 38, 45)
    return Case(scene, view(), "none of those outside the image")


@case("scales as large as 1e30")
def scales_as_large_as_1e30() -> Case:
    scene = cloud(62, seed=24)
    scene[2] = torch.logspace(0, 30, 62)[:, None] * torch.tensor([1.0, 1.0, 1.0])
    scene[2][::2, 0] = 1e-3
    scene[3] *= 0.1
    return Case(scene, view(), "veils, and bands where one axis is short")


@case("zero and denormal scales")
def zero_and_denormal_scales() -> Case:
    scene = cloud(60, seed=25)
    scene[2] = torch.tensor([0.0, 1e-45, 1e-40, 1e-38, 1e-30])[torch.arange(180).reshape(60, 3) * 7 % 5]
    return Case(scene, view(), "dots of the dilation")


@case("channels of 1e30")
def channels_of_1e30() -> Case:
    scene = cloud(100, seed=26)
    scene[4] *= 1e30
    return Case(scene, view(), "errors relative to the largest value")


@case("a focal length of a million")
def a_focal_length_of_a_million() -> Case:
    scene = cloud(100, seed=27)
    scene[0][:, :2] *= 5e-5
    scene[2] *= 5e-5
    return Case(scene, view(focal=1e6), "as any other")


@case("a field of view of 175 degrees")
def a_field_of_view_of_175_degrees() -> Case:
    scene = cloud(200, seed=28, sigma=0.3)
    scene[0] = scene[0] * torch.tensor([30.0, 30.0, 0.5])
    scene[3] *= 0.5
    return Case(scene, view(focal=1.0), "the projection is linearised no farther out than 1.3 times the image")


def _seed(value: int) -> torch.Generator:
    return torch.Generator().manual_seed(value)

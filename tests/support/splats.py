"""Random Gaussians in front of a camera, for the tests of the rasterizer."""

import numpy as np
import torch

from r5dgs_core.raster import RasterStats, rasterize_splats
from r5dgs_core.scene.cameras import Camera

NAMES = ("means", "quats", "scales", "opacities", "channels", "background")


def camera(width=48, height=40, focal=50.0, skew=0.0, offset=(0.0, 0.0)):
    """A camera three units before the origin, slightly turned."""
    intrinsics = np.array([[focal, skew, width / 2 + offset[0]], [0, 1.1 * focal, height / 2 + offset[1]], [0, 0, 1.0]])
    angle = 0.2
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T_cam_world[:3, 3] = [0.1, -0.05, 3.0]
    return Camera(width, height, intrinsics, T_cam_world)


def splats(n=600, n_channels=5, seed=0, radius_px=7.0):
    """Inputs of `rasterize_splats` as float32 values in float64 tensors, so that both precisions see the same scene.

    ``radius_px`` is about the median of three standard deviations before `camera`.
    """
    random = np.random.default_rng(seed)
    scales = np.exp(0.5 * random.normal(size=(n, 1)) + 0.5 * random.normal(size=(n, 3))) * radius_px / 100
    values = (
        random.uniform(-1, 1, (n, 3)),
        random.normal(size=(n, 4)),
        scales,
        random.uniform(0.02, 1.0, n),
        random.uniform(0, 1, (n, n_channels)),
    )
    return [torch.tensor(v, dtype=torch.float32).double() for v in values]


def draw(inputs, view, backend, background=None, upstream_seed=7, **options):
    """Render, send a random gradient back through image, alpha and depth; returns outputs, gradients and stats."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = [t.detach().to(dtype).clone().requires_grad_() for t in inputs]
    behind = None if background is None else background.detach().to(dtype).clone().requires_grad_()
    stats = RasterStats()
    result = rasterize_splats(*leaves, view, behind, backend=backend, stats=stats, **options)
    generator = torch.Generator().manual_seed(upstream_seed)
    # Depth weighted by alpha, as a loss would: where alpha is 1/255, dividing by it amplifies rounding 255 times.
    outputs = (result.image, result.alpha, result.depth * result.alpha.detach())
    loss = sum((o * torch.randn(o.shape, generator=generator, dtype=torch.float64)).sum() for o in outputs)
    if loss.requires_grad:
        loss.backward()
    gradients = {name: leaf.grad for name, leaf in zip(NAMES, leaves, strict=False)}
    if behind is not None:
        gradients["background"] = behind.grad
    return result, gradients, stats


def relative(found, expected):
    """Largest difference, relative to the largest entry."""
    found, expected = found.detach().double(), expected.detach().double()
    return ((found - expected).abs().max() / expected.abs().max().clamp_min(1e-12)).item()

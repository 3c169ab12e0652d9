"""Weights of Gaussians in segments: their sums, the picture made of them, and agreement of the backends."""

import numpy as np
import pytest
import torch

from r5dgs_core.raster import RasterSettings, rasterize_splats
from r5dgs_core.render import segment_weights
from r5dgs_core.scene import cameras

SIZE = 24


@pytest.fixture
def splats():
    rng = np.random.default_rng(4)
    count = 60
    return (
        torch.from_numpy(rng.uniform(-0.8, 0.8, (count, 3)).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32)),
        torch.from_numpy(rng.uniform(0.02, 0.2, (count, 3)).astype(np.float32)),
        torch.from_numpy(rng.uniform(0.1, 0.9, count).astype(np.float32)),
    )


@pytest.fixture
def camera():
    intrinsics = np.array([[30.0, 0, SIZE / 2], [0, 30.0, SIZE / 2], [0, 0, 1]])
    pose = np.eye(4)
    pose[2, 3] = 3.0
    return cameras.Camera(SIZE, SIZE, intrinsics, pose)


@pytest.mark.parametrize("count", [3, 70])
def test_blended_sums_over_segments_are_weights_times_values(splats, camera, count):
    segments = torch.from_numpy(np.random.default_rng(0).integers(-1, count, (SIZE, SIZE)))
    weights = segment_weights.segment_weights(*splats, camera, segments, count)
    values = torch.from_numpy(np.random.default_rng(1).normal(size=(weights.shape[1], 2)).astype(np.float32))
    image = rasterize_splats(*splats, values, camera).image
    sums = torch.stack([image[segments == k].sum(0) for k in range(count)])
    torch.testing.assert_close(torch.from_numpy(weights @ values.numpy()), sums, atol=1e-4, rtol=1e-4)


def test_weights_of_all_segments_are_the_opacity_of_the_image(splats, camera):
    segments = torch.zeros(SIZE, SIZE, dtype=torch.int64)
    weights = segment_weights.segment_weights(*splats, camera, segments, 1)
    alpha = rasterize_splats(*splats, splats[0], camera).alpha
    assert weights.sum() == pytest.approx(alpha.sum().item(), rel=1e-5)


@pytest.fixture
def crowd():
    """Many Gaussians, some of which close what lies behind them."""
    rng = np.random.default_rng(7)
    count = 1500
    arrays = (
        np.stack([rng.uniform(-1.5, 1.5, count), rng.uniform(-1.0, 1.0, count), rng.uniform(-1, 1, count)], 1),
        rng.normal(size=(count, 4)),
        rng.uniform(0.005, 0.15, (count, 3)),
        rng.choice([0.004, 0.05, 0.6, 1.0], count),
    )
    return tuple(torch.from_numpy(array.astype(np.float32)) for array in arrays)


def test_every_backend_finds_the_same_weights(crowd):
    width, height = 83, 50  # tiles at two borders are cut
    intrinsics = np.array([[80.0, 0, width / 2], [0, 80.0, height / 2], [0, 0, 1]])
    pose = np.eye(4)
    pose[2, 3] = 3.0
    view = cameras.Camera(width, height, intrinsics, pose)
    segments = torch.full((height, width), 2)
    segments[:, 40:] = 0  # whole blocks of one segment, blocks of several, and pixels of none
    segments[11:37, 17:61] = 1
    segments[20:24, 20:24] = -1
    segments[:5] = torch.from_numpy(np.random.default_rng(1).integers(0, 5, (5, width)))
    fast, plain = (
        segment_weights.segment_weights(*crowd, view, segments, 6, backend=backend) for backend in ("cpu", "reference")
    )
    assert fast.shape == plain.shape == (6, len(crowd[0])) and fast[5].nnz == 0
    np.testing.assert_allclose(fast.toarray(), plain.toarray(), atol=2e-4, rtol=1e-4)


def test_segments_of_another_size_are_refused(splats, camera):
    with pytest.raises(ValueError, match=r"segments: expected shape \(24, 24\), the image's, got \(24, 23\)"):
        segment_weights.segment_weights(*splats, camera, torch.zeros(SIZE, SIZE - 1, dtype=torch.int64), 1)


def test_weights_neither_need_nor_leave_gradients(splats, camera):
    means = splats[0].clone().requires_grad_(True)
    with torch.no_grad():
        weights = segment_weights.segment_weights(
            means, *splats[1:], camera, torch.zeros(SIZE, SIZE), 1, settings=RasterSettings()
        )
    assert means.grad is None
    assert weights.nnz and (weights.data > 0).all()

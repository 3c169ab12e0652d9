"""Weights of Gaussians in segments: what they add up to, and that a picture is made of them."""

import numpy as np
import pytest
import torch

from r5dgs_core.raster import RasterSettings, rasterize_splats, segment_weights
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
    values = torch.from_numpy(np.random.default_rng(1).normal(size=(len(weights), 2)).astype(np.float32))
    image = rasterize_splats(*splats, values, camera).image
    sums = torch.stack([image[segments == k].sum(0) for k in range(count)])
    torch.testing.assert_close(weights.T @ values, sums, atol=1e-4, rtol=1e-4)


def test_weights_of_all_segments_are_the_opacity_of_the_image(splats, camera):
    segments = torch.zeros(SIZE, SIZE, dtype=torch.int64)
    weights = segment_weights.segment_weights(*splats, camera, segments, 1)
    alpha = rasterize_splats(*splats, splats[0], camera).alpha
    torch.testing.assert_close(weights.sum(), alpha.sum(), atol=1e-3, rtol=1e-5)


def test_no_gradient_is_asked_for_and_none_is_left(splats, camera):
    means = splats[0].clone().requires_grad_(True)
    with torch.no_grad():
        weights = segment_weights.segment_weights(
            means, *splats[1:], camera, torch.zeros(SIZE, SIZE), 1, settings=RasterSettings()
        )
    assert not weights.requires_grad and means.grad is None
    assert (weights >= 0).all() and (weights > 0).any()

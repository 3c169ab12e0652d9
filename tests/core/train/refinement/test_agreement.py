"""Corrections count as evidence only if opposite sides of the pictures agree on them."""

import numpy as np
import pytest

from r5dgs_core.render.camera_fit import Normal, Units
from r5dgs_core.scene.camera_correction import COUNT, POSE
from r5dgs_core.train.refinement import agreement, gauge
from r5dgs_core.train.refinement.agreement import Examined
from r5dgs_core.train.refinement.refinement import PARTS, POSES
from tests.support import tiny_datasets

SIDE, PIXELS, NOISE, SPACING = 6, 80, 0.05, 0.1
UNITS = Units(4.0, 0.01)
POINTS = np.random.default_rng(1).normal([0, 0, 0.45], 0.4, (500, 3))


def examined(change, seed):
    """A camera whose pictures need a change, given by row and column of the tile; slopes are random."""
    rng, camera = np.random.default_rng(seed), tiny_datasets.orbit_camera(0.7 * seed, 96, 72)
    steps = np.concatenate([UNITS.steps(camera), np.full(12, 0.02)])
    tiles = []
    for row in range(SIDE):
        for column in range(SIDE):
            slopes = rng.normal(size=(PIXELS, COUNT)) / steps
            left = slopes @ change(row, column) + rng.normal(size=PIXELS) * NOISE
            tiles.append(Normal(slopes.T @ slopes, slopes.T @ left, float(left @ left), PIXELS))
    return Examined(camera, tiles)


def evidence(changes):
    poses = [examined(change, seed) for seed, change in enumerate(changes)]
    return agreement.examine(poses, PARTS, UNITS, POINTS, SPACING)


def changed(index, size):
    return size * np.eye(COUNT)[index]


def test_errors_of_a_camera_are_found_in_their_units():
    signs = np.resize([1, -1], 6)
    late = evidence([lambda row, column, s=s: changed(7, 0.3 * SPACING * s) for s in signs])
    assert late["time_offsets"].size == pytest.approx(0.3, rel=0.1) and late["time_offsets"].gain > 1
    red = evidence([lambda row, column, s=s: changed(17, 0.1 * s) for s in signs])
    assert red["camera_colours"].size == pytest.approx(0.1 / 3**0.5, rel=0.1)
    wide = evidence([lambda row, column, s=s: changed(6, 2 * s / 96) for s in signs])
    assert wide["focal_lengths"].size == pytest.approx(1.0, rel=0.1)
    focal = tiny_datasets.orbit_camera(0, 96, 72).intrinsics[0, 0]
    turned = evidence([lambda row, column, s=s: changed(0, s / focal) for s in signs])
    assert 0.7 < turned["camera_poses"].size < 1.3


@pytest.mark.parametrize("axis", [0, 1])
def test_sides_that_need_opposite_corrections_are_no_evidence(axis):
    def torn(row, column):
        return changed(0, 0.02 if (row, column)[axis] < SIDE / 2 else -0.02)

    found = evidence([torn if k % 2 else (lambda row, column: -torn(row, column)) for k in range(6)])
    assert found["camera_poses"].size == 0.0


def test_noise_alone_is_no_evidence():
    found = evidence([lambda row, column: np.zeros(COUNT)] * 6)
    assert found["camera_poses"].size < 0.05
    assert max(one.size for one in found.values()) < 0.05


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("count", [3, 4, 10])
def test_independent_fits_of_few_cameras_rarely_agree(part, count):
    cameras = [tiny_datasets.orbit_camera(0.6 * k, 96, 72) for k in range(count)]
    units = np.stack([gauge.pixel_units(camera, POINTS) for camera in cameras])
    rng, sizes = np.random.default_rng(3), []
    for _ in range(400):
        fits = rng.normal(size=(2, count, COUNT))
        fits[..., POSE] = np.einsum("rij,frj->fri", units, rng.normal(size=(2, count, 6)))
        sizes.append(agreement.agreed(part, cameras, *fits, POINTS, SPACING))
    assert np.mean(np.array(sizes) > 0) < 0.05


@pytest.mark.parametrize("part", PARTS)
def test_two_cameras_have_a_single_difference_of_focal_lengths_and_clocks(part):
    cameras = [tiny_datasets.orbit_camera(0.6 * k, 96, 72) for k in range(2)]
    change = np.random.default_rng(4).normal(size=(2, COUNT))
    size = agreement.agreed(part, cameras, change, 1.1 * change, POINTS, SPACING)
    assert (size > 0) == (part in (POSES, "camera_colours"))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("part", PARTS)
def test_one_camera_is_no_evidence(part):
    change = np.ones((1, COUNT))
    assert agreement.agreed(part, [tiny_datasets.orbit_camera(0, 96, 72)], change, change, POINTS, SPACING) == 0.0


def test_both_sides_see_what_moves():
    pose = examined(lambda row, column: np.zeros(COUNT), 0)
    still = np.eye(COUNT)
    still[7, 7] = 0.0
    tiles = []
    for number, tile in enumerate(pose.tiles):
        keep = np.eye(COUNT) if number % SIDE >= SIDE - 2 else still  # only the two last columns show motion
        tiles.append(Normal(keep @ tile.matrix @ keep, keep @ tile.vector, tile.error, tile.pixels))
    for a, b in Examined(pose.camera, tiles).sides("time_offsets", UNITS):
        assert 0.4 < a.matrix[7, 7] / (a.matrix[7, 7] + b.matrix[7, 7]) < 0.6

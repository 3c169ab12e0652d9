"""The gauge removes what all cameras share, and the units of a pose move the picture by a pixel."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.scene import cameras
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.train.refinement import gauge
from tests.support import tiny_datasets

RIG = [tiny_datasets.orbit_camera(angle, 48, 36) for angle in np.linspace(0, 5, 6)]
POINTS = np.random.default_rng(0).normal([0, 0, 0.4], 0.6, (400, 3))


@pytest.fixture(scope="module")
def units():
    return np.stack([gauge.pixel_units(camera, POINTS) for camera in RIG])


def test_a_motion_of_the_world_is_no_correction(units):
    small = 1e-4
    world = np.array([0.3, -0.5, 0.8, 0.2, 0.7, -0.4, 0.6]) * small
    turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(world[:3]))
    moved = POINTS @ turn.T * (1 + world[6]) + world[3:6]
    shared = np.stack([gauge.similarity_slopes(camera) @ world for camera in RIG])
    for camera, change in zip(RIG, shared, strict=True):  # the corrected camera sees the moved world as before
        inverse = Correction(rotvec=-change[:3], shift=-change[3:])
        before, _ = cameras.project(camera, POINTS)
        after, _ = cameras.project(inverse.camera(camera), moved)
        np.testing.assert_allclose(after, before, atol=1e-4)
    assert np.abs(gauge.Gauge(RIG, units).fix(shared)).max() < 1e-3 * np.abs(shared).max()


def test_fixing_twice_changes_nothing_and_keeps_the_differences_of_cameras(units):
    found = gauge.Gauge(RIG, units)
    noise = np.random.default_rng(1).normal(0, 0.01, (6, 6))
    once = found.fix(noise)
    np.testing.assert_allclose(found.fix(once), once, atol=1e-12)
    assert np.abs(once - noise).max() > 1e-4
    assert np.abs(once).max() > 1e-3


def test_each_unit_moves_the_picture_by_at_most_a_pixel(units):
    small = 1e-3
    for camera, unit in zip(RIG, units, strict=True):
        before, _ = cameras.project(camera, POINTS)
        inside = ((before >= 0) & (before < [camera.width, camera.height])).all(1)
        shifts = []
        for column in unit.T:
            change = Correction(rotvec=small * column[:3], shift=small * column[3:])
            after, _ = cameras.project(change.camera(camera), POINTS)
            shifts.append(np.sqrt(((after - before)[inside] ** 2).sum(1).mean()) / small)
        assert max(shifts) == pytest.approx(1.0, rel=0.02)
        assert min(shifts) > 0.1


def test_a_camera_without_points_gets_units_of_rotation():
    away = dataclasses.replace(RIG[0], T_cam_world=np.diag([1.0, 1, 1, 1]))
    unit = gauge.pixel_units(away, np.zeros((0, 3)))
    np.testing.assert_allclose(unit, np.eye(6) / away.intrinsics[0, 0])

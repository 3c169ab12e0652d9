"""Normalised coordinates: the same for a scene in any place and of any size, and defined for any cameras."""

import dataclasses

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from r5dgs_core.scene import cameras
from r5dgs_core.train import normalization
from tests.support import scenes

RING = [scenes.orbit_camera(a) for a in (0.1, 1.0, 2.3, 4.0, 5.5)]


def moved(camera, scale, shift):
    T = camera.T_cam_world.copy()
    T[:3, 3] = scale * T[:3, 3] - T[:3, :3] @ shift
    return dataclasses.replace(camera, T_cam_world=T)


def looking(position, forward):
    """A camera at a place that looks along a direction."""
    return scenes.looking_camera(position, forward, 0.8, 32, 24, up=(0.1, 0.2, 1.0))


def test_the_focus_becomes_the_origin_and_the_cameras_stand_at_four_units():
    norm = normalization.from_cameras(RING)
    np.testing.assert_allclose(norm.origin, 0, atol=1e-9)
    distances = [np.linalg.norm(norm.camera(c).center) for c in RING]
    assert np.median(distances) == pytest.approx(normalization.TARGET_DISTANCE)


@hypothesis.given(st.floats(1e-3, 1e3), st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_scaled_and_shifted_worlds_have_the_same_normalised_cameras(scale, shift):
    there = [moved(c, scale, np.array(shift)) for c in RING]
    here_norm, there_norm = normalization.from_cameras(RING), normalization.from_cameras(there)
    atol = 1e-9 * (1 + np.abs(shift).max() / scale)
    for a, b in zip(RING, there, strict=True):
        np.testing.assert_allclose(here_norm.camera(a).T_cam_world, there_norm.camera(b).T_cam_world, atol=atol)


@hypothesis.given(st.tuples(*[st.floats(-2, 2)] * 3))
def test_points_and_cameras_change_together(point):
    norm = normalization.Normalization(np.array([3.0, -1.0, 20.0]), 2.5)
    for camera in RING:
        pixels, z = cameras.project(norm.camera(camera), np.array(point))
        world, z_world = cameras.project(camera, norm.points_to_world(np.array(point)))
        np.testing.assert_allclose(world, pixels, atol=1e-6)
        assert z_world == pytest.approx(2.5 * z, abs=1e-9)


@pytest.mark.parametrize(
    "given",
    [
        pytest.param([looking([x, 0, 1], [0, 1, 0]) for x in (-1.0, 0.0, 1.0)], id="parallel"),
        pytest.param([looking([np.cos(a), np.sin(a), 0], [np.cos(a), np.sin(a), 0]) for a in range(6)], id="outward"),
        pytest.param([looking([1.0, 2, 3], [0, 1, 0])], id="one"),
        pytest.param([looking([1.0, 2, 3], [np.cos(a), np.sin(a), 0.1]) for a in range(5)], id="turning on the spot"),
        pytest.param([looking([1.0, 2, 3], [0, 1, 0])] * 3, id="equal"),
    ],
)
def test_cameras_without_a_focus_still_get_coordinates(given):
    norm = normalization.from_cameras(given)
    assert np.isfinite(norm.origin).all() and 0 < norm.scale < np.inf
    reach = max(np.linalg.norm(norm.camera(c).center) for c in given)
    assert reach < 10 * normalization.TARGET_DISTANCE

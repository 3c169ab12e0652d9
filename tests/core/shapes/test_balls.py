"""Balls are found among the outlines of objects."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.shapes import balls, directions, silhouettes, solid
from tests.support import solid_gaussians

NORMALS = directions.sphere(300)
CENTER = np.array([1.0, -2.0, 0.5])
RADIUS = 0.3


def planes(points):
    """Normals and distances of planes that touch the convex hull of points [N, 3]."""
    return NORMALS, (NORMALS @ points.T).max(axis=1)


def sphere(count=500):
    return CENTER + RADIUS * directions.sphere(count)


def assert_ball(found, radius=RADIUS):
    np.testing.assert_allclose(found.mean(axis=0), CENTER, atol=0.01 * RADIUS)
    assert solid.of(found).volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.03)
    apart = np.linalg.norm(found - CENTER, axis=1)
    assert np.ptp(apart) < 0.03 * RADIUS


def test_a_ball_is_found_with_its_centre_and_volume():
    assert_ball(balls.of(*planes(sphere())))


def supported(wide):
    """Points of a ball and of Gaussians below it, which reach a third of the radius deeper."""
    turns = np.linspace(0, 2 * np.pi, 40)
    below = np.stack([wide * np.cos(turns), wide * np.sin(turns), np.full(40, -1.3)], axis=1)
    return np.concatenate([sphere(), CENTER + RADIUS * below])


@pytest.mark.parametrize("wide", [0.2, 0.5])
def test_what_fills_the_space_between_a_ball_and_its_support_does_not_count(wide):
    assert_ball(balls.of(*planes(supported(wide))))


def test_rough_outlines_and_a_filled_space_below_a_ball_together_leave_it_a_ball():
    normals, reach = planes(supported(0.6))
    rough = reach + RADIUS * np.random.default_rng(0).normal(0, 0.028, len(reach))
    assert np.median(np.abs((rough - normals @ CENTER) / RADIUS - 1)) > balls._ALIKE
    found = balls.of(normals, rough)
    np.testing.assert_allclose(found.mean(axis=0), CENTER, atol=0.03 * RADIUS)
    assert solid.of(found).volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)


def cylinder(height):
    turns = np.linspace(0, 2 * np.pi, 60)
    ring = np.stack([np.cos(turns), np.sin(turns), np.zeros(60)], axis=1)
    return np.concatenate([ring + [0, 0, height], ring - [0, 0, height]])


def others():
    dome = directions.sphere(500)
    return {
        "cube": np.sign(directions.sphere(64)),
        "can": cylinder(0.8),
        "dome": dome[dome[:, 2] > 0],
        "egg": dome * [1, 1, 1.25],
        "peg": np.concatenate([dome + [0, 0, 0.3], dome - [0, 0, 0.3]]),
    }


@pytest.mark.parametrize("name", others())
def test_other_shapes_are_no_balls(name):
    assert balls.of(*planes(others()[name])) is None


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_the_ball_scales_with_the_object(scale):
    found = balls.of(*planes(scale * supported(0.5)))
    np.testing.assert_allclose(found / scale, balls.of(*planes(supported(0.5))), atol=1e-6 * RADIUS)


def test_the_outlines_of_gaussians_give_the_ball():
    means, quats, scales, opacities = solid_gaussians.ball(RADIUS, center=CENTER)
    outlines = silhouettes.of(means, rotations.normalize(quats), scales, opacities)
    radius = np.sqrt(np.mean([one.mask.sum() * one.step**2 for one in outlines]) / np.pi)  # of discs with their areas
    assert_ball(balls.of(*silhouettes.tangents(outlines)), radius)

"""Convex bodies: mass properties against formulas, and feet."""

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.motion import rotations
from r5dgs_core.shapes import solid

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e4])
def test_a_turned_box_has_the_mass_properties_of_a_box(scale):
    turn = rotations.quats_to_rotmats(rotations.normalize(np.array([0.8, 0.3, -0.4, 0.2])))
    sides, center = scale * np.array([2.0, 0.5, 1.0]), scale * np.array([5.0, -3, 2])
    found = solid.of((CORNERS * sides) @ turn.T + center)
    mass, (a, b, c) = sides.prod(), sides**2
    assert found.volume == pytest.approx(mass)
    np.testing.assert_allclose(found.center, center, rtol=1e-9)
    expected = turn @ np.diag(mass / 12 * np.array([b + c, a + c, a + b])) @ turn.T
    np.testing.assert_allclose(found.inertia, expected, rtol=1e-8, atol=1e-9 * mass * scale**2)


def test_triangles_face_outwards():
    found = solid.of(np.random.default_rng(0).normal(size=(50, 3)))
    a, b, c = np.moveaxis(found.vertices[found.triangles], 1, 0)
    assert (((a + b + c) / 3 - found.center) * np.cross(b - a, c - a)).sum(1).min() > 0
    assert len(found.triangles) == 2 * len(found.vertices) - 4


@pytest.mark.parametrize("points", [np.zeros((5, 3)), CORNERS[:4] * [0, 1, 1], np.eye(3), CORNERS * [1, 1, 1e-12]])
def test_flat_points_are_refused(points):
    with pytest.raises(errors.ConfigError, match="plane|at least 4"):
        solid.of(points)


def test_a_flat_foot_stands_on_three_corners_or_more():
    up = rotations.rotate(rotations.normalize(np.array([0.9, 0.2, 0.1, 0])), np.array([0.0, 0, 1]))
    tip = np.append(CORNERS, [[0, 0, -0.53]], axis=0) + [3, 4, 5]
    vertices = tip @ np.linalg.svd(up[None])[2][[1, 2, 0]]  # its lowest corner is below the others along up
    pressed, floor = solid.with_flat_foot(vertices, up)
    heights = pressed @ up
    assert heights.min() == pytest.approx(floor)
    assert (heights < floor + 1e-9).sum() >= 3
    moved = np.abs(heights - vertices @ up)
    assert moved.max() < 0.07 * np.ptp(vertices, axis=0).max()
    np.testing.assert_allclose(np.cross(pressed - vertices, up), 0, atol=1e-9)


def test_the_foot_grows_until_the_body_stands():
    rng, up = np.random.default_rng(2), np.array([0.0, 0, 1])
    towards = rng.normal(size=(200, 3))
    vertices = towards / np.linalg.norm(towards, axis=1, keepdims=True) * [1, 1, 0.6]  # an egg on its belly
    vertices[:, 0] += 2 * vertices[:, 2]  # leaning over
    pressed, floor = solid.with_flat_foot(vertices, up, foot=0.005)
    body = solid.of(pressed)
    foot = body.vertices[np.abs(body.vertices[:, 2] - floor) < 1e-9, :2]
    for angle in np.linspace(0, 2 * np.pi, 64):
        side = np.array([np.cos(angle), np.sin(angle)])
        assert (foot @ side).max() > body.center[:2] @ side
    assert len(foot) >= 3


@pytest.mark.parametrize("thickness", [0.05, 0.01, 1e-4])
def test_a_thin_body_keeps_most_of_its_height(thickness):
    up = np.array([0.0, 0, 1])
    pressed, floor = solid.with_flat_foot(CORNERS * [1, 1, thickness], up)
    assert np.ptp(solid.of(pressed).vertices @ up) >= 0.7 * thickness
    assert floor + 0.5 * thickness <= 0.3 * thickness


def test_the_normals_of_a_box_are_those_of_its_sides():
    found = solid.of(CORNERS * [1, 2, 3]).normals
    assert {tuple(row) for row in found.round(9) + 0.0} == {
        tuple(row) for row in np.concatenate([np.eye(3), -np.eye(3)])
    }

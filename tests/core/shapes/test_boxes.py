"""Boxes are found among the hulls of silhouettes."""

import itertools

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.shapes import boxes, directions, silhouette_hull, silhouettes

SIDES = np.array([0.3, 0.45, 0.6])
TURN = rotations.normalize(np.array([0.8, 0.3, -0.4, 0.2]))
CENTER = np.array([1.0, -2.0, 0.5])
CORNERS = 0.5 * np.array(list(itertools.product((-1, 1), repeat=3)))


def sides(corners):
    return np.sort([np.linalg.norm(corners[k] - corners[0]) for k in (1, 2, 4)])


def test_the_corners_of_a_box_are_its_own():
    corners = rotations.rotate(TURN[None], CORNERS * SIDES) + CENTER
    found = boxes.of_hull(corners)
    nearest = np.linalg.norm(found[:, None] - corners, axis=2).min(axis=1)
    assert nearest.max() < 1e-3


def test_the_silhouettes_of_a_box_bulge_over_its_faces_and_give_the_box():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (4000, 3))
    axis = np.argmax(np.abs(points), axis=1)
    points[np.arange(len(points)), axis] = np.sign(points[np.arange(len(points)), axis])
    means = rotations.rotate(TURN[None], 0.5 * points * SIDES) + CENTER
    quats, scales = rotations.identity(len(means)), np.full((len(means), 3), 0.01)
    hull = silhouette_hull.of(means, quats, scales, np.full(len(means), 0.9))
    wide = np.ptp(rotations.rotate(rotations.conjugate(TURN)[None], hull.vertices), axis=0)
    assert (wide > 1.08 * SIDES).any()
    found = boxes.of_hull(hull.vertices)
    np.testing.assert_allclose(sides(found), SIDES, rtol=0.06)
    np.testing.assert_allclose(found.mean(axis=0), CENTER, atol=0.01)
    outlines = silhouettes.of(means, quats, scales, np.full(len(means), 0.9))
    found = boxes.of(*silhouettes.tangents(outlines))
    np.testing.assert_allclose(sides(found), SIDES, rtol=0.04)
    np.testing.assert_allclose(found.mean(axis=0), CENTER, atol=0.01)


def prism(count, height):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.column_stack([ring, np.full(count, z)]) for z in (-height, height)])


@pytest.mark.parametrize(
    "vertices", [directions.sphere(64), prism(24, 1.0), prism(6, 0.8), CORNERS[:7]], ids=["ball", "can", "nut", "cut"]
)
def test_other_shapes_are_no_boxes(vertices):
    assert boxes.of_hull(vertices) is None

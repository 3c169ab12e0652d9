"""Convex hulls of objects of Gaussians, against ellipsoids and boxes of known size."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from r5dgs_core.motion import rotations
from r5dgs_core.shapes import convex_hull


def box(count=3000, size=(1.0, 0.6, 0.3), opacity=0.8):
    """Thin flat Gaussians on the surface of a box."""
    size, rng = np.array(size), np.random.default_rng(3)
    means = rng.uniform(-0.5, 0.5, (count, 3)) * size
    side = rng.integers(0, 3, count)
    means[np.arange(count), side] = np.sign(rng.normal(size=count)) * 0.5 * size[side]
    scales = np.full((count, 3), 0.02)
    scales[np.arange(count), side] = 1e-3
    return means, np.tile([1.0, 0, 0, 0], (count, 1)), scales, np.full(count, opacity)


def test_the_hull_of_one_gaussian_is_its_ellipsoid():
    turn = rotations.normalize(np.array([[0.9, 0.1, -0.3, 0.2]]))
    scales, opacity = np.array([[0.3, 0.2, 0.1]]), 0.7
    found = convex_hull.vertices(np.array([[1.0, 2, 3]]), turn, scales, np.array([opacity]))
    assert len(found) == convex_hull.MAX_VERTICES
    local = (found - [1, 2, 3]) @ rotations.quats_to_rotmats(turn)[0] / scales[0]
    exponent = (local**2).sum(1) / 2
    np.testing.assert_allclose(opacity * np.exp(-exponent), convex_hull.LEVEL, rtol=1e-9)
    sigmas = np.sqrt(2 * np.log(opacity / convex_hull.LEVEL))
    volume = ConvexHull(found).volume / (4 / 3 * np.pi * sigmas**3 * scales.prod())
    assert 0.85 < volume < 1


def test_the_hull_of_a_box_has_its_size():
    found = convex_hull.vertices(*box())
    grown = np.ptp(found, axis=0) - [1.0, 0.6, 0.3]
    assert ((grown > 0) & (grown < 0.1)).all()
    assert ConvexHull(found).volume == pytest.approx(np.ptp(found, axis=0).prod(), rel=0.12)


def test_more_vertices_fit_better_and_all_are_on_the_hull():
    gaussians = box()
    volumes = [ConvexHull(convex_hull.vertices(*gaussians, most=most)).volume for most in (8, 20, 64)]
    assert volumes[0] < volumes[1] < volumes[2]
    found = convex_hull.vertices(*gaussians)
    assert len(ConvexHull(found).vertices) == len(found) <= 64


def test_floaters_and_faint_gaussians_are_left_out():
    means, quats, scales, opacities = box()
    rng = np.random.default_rng(4)
    expected = convex_hull.vertices(means, quats, scales, opacities)
    means = np.concatenate([means, rng.normal(size=(30, 3)) + 4, [[0, 0, 0.8]], rng.normal(size=(200, 3))])
    more = len(means) - len(quats)
    quats, scales = np.concatenate([quats, quats[:more]]), np.concatenate([scales, scales[:more]])
    opacities = np.concatenate([opacities, np.full(31, 0.9), np.full(200, 0.1)])
    found = convex_hull.vertices(means, quats, scales, opacities)
    np.testing.assert_allclose(np.ptp(found, axis=0), np.ptp(expected, axis=0), atol=0.03)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_hull_scales_and_moves_with_the_object(scale):
    means, quats, scales, opacities = box()
    shift = np.array([30.0, -20, 10]) * scale
    found = convex_hull.vertices(scale * means + shift, quats, scale * scales, opacities)
    expected = convex_hull.vertices(means, quats, scales, opacities)
    np.testing.assert_allclose(np.sort(found - shift, 0), scale * np.sort(expected, 0), atol=2e-2 * scale)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_few_gaussians_give_a_hull_or_nothing(count):
    means = np.eye(4, 3)[:count]
    found = convex_hull.vertices(means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.1), np.ones(count))
    assert len(found) <= convex_hull.MAX_VERTICES and np.isfinite(found).all() and (len(found) > 0) == (count > 0)
    assert len(convex_hull.vertices(means, np.ones((count, 4)), np.ones((count, 3)), np.zeros(count))) == 0

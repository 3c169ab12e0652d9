"""Hulls from silhouettes: size, robustness, error, and a bound on their vertices."""

import numpy as np
import pytest

from r5dgs_core.shapes import silhouette_hull, silhouettes, solid
from tests.support import solid_gaussians


@pytest.mark.parametrize(
    ("gaussians", "volume"),
    [(solid_gaussians.ball(), 4 / 3 * np.pi), (solid_gaussians.box(), 0.24)],
    ids=["ball", "box"],
)
def test_the_volume_is_that_of_the_body_and_floaters_do_not_count(gaussians, volume):
    clean = solid.of(silhouette_hull.of(*gaussians).vertices)
    assert np.cbrt(clean.volume / volume) == pytest.approx(1, abs=0.12)
    dirty = solid.of(silhouette_hull.of(*solid_gaussians.with_floaters(gaussians)).vertices)
    assert dirty.volume == pytest.approx(clean.volume, rel=0.05)
    np.testing.assert_allclose(dirty.center, clean.center, atol=0.03)


def test_the_error_is_small_for_convex_bodies_and_large_for_others():
    round_one = silhouette_hull.of(*solid_gaussians.ball())
    assert 4 <= len(round_one.vertices) <= 64 and 0 < round_one.error < 0.04
    parts = [solid_gaussians.ball(0.5, 300, (x, y, 0), seed=3) for x, y in ((0, 0), (0.9, 0), (0, 0.9))]
    corner = silhouette_hull.of(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    assert corner.error > 1.5 * round_one.error


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_hull_scales_and_moves_with_the_object(scale):
    means, quats, scales, opacities = solid_gaussians.ball()
    shift = scale * np.array([30.0, -20, 10])
    found = silhouette_hull.of(scale * means + shift, quats, scale * scales, opacities)
    expected = silhouette_hull.of(means, quats, scales, opacities)
    assert solid.of((found.vertices - shift) / scale).volume == pytest.approx(
        solid.of(expected.vertices).volume, rel=1e-3
    )
    assert found.error == pytest.approx(scale * expected.error, rel=0.05)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_few_gaussians_give_a_hull_and_faint_ones_none(count):
    means, quats = 0.1 * np.eye(4, 3)[:count], np.tile([1.0, 0, 0, 0], (count, 1))
    found = silhouette_hull.of(means, quats, np.full((count, 3), 0.1), np.ones(count))
    assert (found is not None) == (count > 0)
    if found is not None:
        assert np.isfinite(found.vertices).all() and solid.of(found.vertices).volume > 0
    assert silhouette_hull.of(means, quats, np.full((count, 3), 0.1), np.full(count, 0.05)) is None


def test_a_silhouette_is_the_outline_of_the_joint_opacity():
    one = (np.array([[1.0, 2, 3]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 0.2), np.array([0.9]))
    radius = 0.2 * np.sqrt(2 * np.log(0.9 / silhouettes.LEVEL))
    for found in silhouettes.of(*one):
        reach = found.sides - found.basis @ one[0][0] @ silhouettes.directions.circle(silhouettes.SIDES).T
        np.testing.assert_allclose(reach, radius, rtol=0.06)


def test_large_gaussians_beside_the_picture_are_drawn():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(20, 28, (50, 2)), [[-60.0, 24.0], [110.0, 24.0], [24.0, -60.0]]])
    covariances = np.concatenate([np.tile(np.eye(2), (50, 1, 1)), np.tile(28.0**2 * np.eye(2), (3, 1, 1))])
    opacities = np.full(53, 0.9)
    found = silhouettes._draw(points, covariances, opacities, (49, 49))
    cells = np.stack(np.meshgrid(np.arange(49), np.arange(49), indexing="ij"), axis=-1)
    apart = cells[:, :, None] - points
    sigma = np.sqrt(covariances[:, 0, 0] + silhouettes._BLUR**2)
    alpha = opacities * np.exp(-0.5 * (apart**2).sum(axis=-1) / sigma**2)
    np.testing.assert_allclose(found, 1 - np.prod(1 - alpha, axis=-1), atol=0.02)

"""Spherical harmonics are orthonormal, have the signs of 3DGS files, and are the same in numpy and torch."""

import numpy as np
import pytest
import torch

from r5dgs_core.motion import rotations
from r5dgs_core.scene import spherical_harmonics as harmonics


def sphere_quadrature(n=16):
    """Directions and weights that integrate polynomials up to degree 2 n - 1 on the sphere exactly."""
    z, weights = np.polynomial.legendre.leggauss(n)
    angle = np.arange(2 * n) * np.pi / n
    z, angle = (grid.ravel() for grid in np.meshgrid(z, angle, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1), np.repeat(weights, 2 * n) * np.pi / n


def test_basis_is_orthonormal():
    directions, weights = sphere_quadrature()
    values = harmonics.basis(directions, 3)
    np.testing.assert_allclose((values * weights[:, None]).T @ values, np.eye(16), atol=1e-12)


def test_each_degree_is_a_harmonic_polynomial_of_that_parity():
    directions, _ = sphere_quadrature()
    values, mirrored = harmonics.basis(directions, 3), harmonics.basis(-directions, 3)
    parity = np.repeat([1, -1, 1, -1], [1, 3, 5, 7])
    np.testing.assert_allclose(mirrored, parity * values, atol=1e-14)


@pytest.mark.parametrize(
    ("direction", "index", "value"),
    [  # constants of the 3DGS viewer's formulas
        ((0, 1, 0), 1, -0.4886025119029199),
        ((0, 0, 1), 2, 0.4886025119029199),
        ((1, 0, 0), 3, -0.4886025119029199),
        ((1, 1, 0), 4, 1.0925484305920792),
        ((0, 1, 1), 5, -1.0925484305920792),
        ((0, 0, 1), 6, 2 * 0.31539156525252005),
        ((1, 0, 1), 7, -1.0925484305920792),
        ((1, 0, 0), 8, 0.5462742152960396),
        ((0, 1, 0), 9, 0.5900435899266435),
        ((1, 1, 1), 10, 2.890611442640554),
        ((0, 1, 1), 11, -0.4570457994644658 * 3),
        ((0, 0, 1), 12, 0.3731763325901154 * 2),
        ((1, 0, 1), 13, -0.4570457994644658 * 3),
        ((1, 0, 1), 14, 1.445305721320277),
        ((1, 0, 0), 15, -0.5900435899266435),
    ],
)
def test_signs_and_order_match_3dgs(direction, index, value):
    assert harmonics.basis(np.array(direction, np.float64), 3)[index] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_numpy_and_torch_agree_and_keep_the_dtype(k):
    random = np.random.default_rng(k)
    sh, directions = random.normal(size=(5, 7, k, 3)), random.normal(size=(5, 7, 3))
    for dtype, torch_dtype in ((np.float32, torch.float32), (np.float64, torch.float64)):
        found = harmonics.to_rgb(sh.astype(dtype), directions.astype(dtype))
        expected = harmonics.to_rgb(torch.tensor(sh, dtype=torch_dtype), torch.tensor(directions, dtype=torch_dtype))
        assert found.dtype == dtype and expected.dtype == torch_dtype
        np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5, atol=1e-5)


def test_dc_round_trip():
    colors = np.random.default_rng(0).uniform(size=(9, 3))
    np.testing.assert_allclose(harmonics.dc_to_rgb(harmonics.rgb_to_dc(colors)), colors, atol=1e-15)
    seen = harmonics.to_rgb(harmonics.rgb_to_dc(colors)[:, None], np.ones((9, 3)))
    np.testing.assert_allclose(seen, colors, atol=1e-15)


def test_other_counts_are_refused():
    with pytest.raises(ValueError, match="1, 4, 9 or 16.*got 5"):
        harmonics.evaluate(np.zeros((2, 5, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="0 to 3, got 4"):
        harmonics.basis(np.zeros((2, 3)), 4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_coefficients_equal_the_old_ones_in_the_rotated_direction(degree):
    draws = np.random.default_rng(degree)
    sh = draws.normal(size=(5, (degree + 1) ** 2, 3))
    quats = rotations.normalize(draws.normal(size=(5, 4)))
    directions = draws.normal(size=(5, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = harmonics.rotate(sh, quats)
    seen = harmonics.evaluate(turned, rotations.rotate(quats, directions))
    np.testing.assert_allclose(seen, harmonics.evaluate(sh, directions), atol=1e-12)
    one = harmonics.rotate(sh, quats[2])
    np.testing.assert_allclose(one[2], turned[2], atol=1e-12)

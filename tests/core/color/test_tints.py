"""A tint multiplies the colour of a Gaussian in every viewing direction."""

import numpy as np
import pytest

from r5dgs_core.color import tints
from r5dgs_core.scene import spherical_harmonics


def colors(sh, basis):
    """Display-referred colours before the clamp. [N, 3]"""
    return 0.5 + np.einsum("k,nkc->nc", basis, sh)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_colour_is_multiplied_in_every_viewing_direction(degree):
    rng = np.random.default_rng(degree)
    count = (degree + 1) ** 2
    sh = rng.normal(size=(50, count, 3))
    tint = np.array([0.2, 1.0, 3.0])
    for _ in range(8):
        basis = np.concatenate([[spherical_harmonics.C0], rng.normal(size=count - 1)])
        np.testing.assert_allclose(colors(tints.tint_sh(sh, tint), basis), tint * colors(sh, basis), atol=1e-12)


def test_each_gaussian_may_have_its_own_tint():
    sh = np.random.default_rng(0).normal(size=(4, 9, 3)).astype(np.float32)
    factors = np.array([[1.0, 1, 1], [0, 0, 0], [0.5, 2, 1], [1, 0.1, 0]])
    together = tints.tint_sh(sh, factors)
    assert together.dtype == np.float32
    for row, factor in enumerate(factors):
        np.testing.assert_array_equal(together[row], tints.tint_sh(sh[row], factor))


def test_white_changes_no_bit():
    sh = np.random.default_rng(0).normal(size=(4, 1, 3)).astype(np.float32)
    assert tints.tint_sh(sh, np.ones(3)) is sh

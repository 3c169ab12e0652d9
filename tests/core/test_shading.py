"""Colours that turn with their body in fixed light."""

from __future__ import annotations

import numpy as np

from r5dgs_core.motion import rotations
from r5dgs_core.train import shading


def test_shading_at_the_bind_state_keeps_every_colour():
    draws = np.random.default_rng(4)
    n, light = 30, np.array([0.3, -0.5, 0.8])
    sh, vectors = draws.normal(size=(n, 4, 3)), 0.2 * draws.normal(size=(n, 3))
    bind, later = rotations.normalize(draws.normal(size=(2, 4)))
    baked_sh, baked_shading = shading.rebind(sh, vectors, bind, light)

    def factor(quat, g):
        return 1 + g @ (rotations.rotate(rotations.conjugate(quat), light) - light)

    total = rotations.multiply(later, bind)
    expected = (0.5 + 0.28209479177 * sh[:, 0]) * factor(total, vectors)[:, None]
    found = (0.5 + 0.28209479177 * baked_sh[:, 0]) * factor(later, baked_shading)[:, None]
    strong = factor(bind, vectors) > shading.MIN_FACTOR
    assert strong.mean() > 0.8
    np.testing.assert_allclose(found[strong], expected[strong], atol=1e-9)
    bands = sh[:, 1:] * factor(total, vectors)[:, None, None]
    np.testing.assert_allclose(
        (baked_sh[:, 1:] * factor(later, baked_shading)[:, None, None])[strong], bands[strong], atol=1e-9
    )


def test_one_rotation_for_each_is_that_rotation_for_all_where_they_are_equal():
    draws = np.random.default_rng(5)
    sh, vectors, light = draws.normal(size=(6, 1, 3)), 0.1 * draws.normal(size=(6, 3)), np.array([0.2, 0.1, 1.0])
    turn = rotations.normalize(draws.normal(size=4))
    one = shading.rebind(sh, vectors, turn, light)
    each = shading.rebind(sh, vectors, np.tile(turn, (6, 1)), light)
    for a, b in zip(one, each, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)

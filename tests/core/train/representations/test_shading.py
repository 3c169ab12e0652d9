"""Colours of bodies that rotate in fixed light."""

from __future__ import annotations

import numpy as np

from r5dgs_core.motion import rotations
from r5dgs_core.train.representations import shading


def test_a_new_bind_state_keeps_every_colour_including_unlit_ones():
    draws = np.random.default_rng(4)
    n, light = 60, np.array([0.3, -0.5, 0.8])
    sh, vectors = draws.normal(size=(n, 4, 3)), 1.5 * draws.normal(size=(n, 3))
    bind, later = rotations.normalize(draws.normal(size=(2, 4)))
    new_sh, new_vectors, rest = shading.rebind(sh, vectors, np.ones(n), bind, light)

    def factor(quat, g, r):
        return np.maximum(r + g @ (rotations.rotate(rotations.conjugate(quat), light) - light), 0)

    assert (rest < 0).mean() > 0.1 and (rest == 1).mean() > 0.4
    for since in (np.array([1.0, 0, 0, 0]), later):
        before = factor(rotations.multiply(since, bind), vectors, 1.0)
        after = factor(since, new_vectors, rest)
        dc = 0.5 + 0.28209479177 * np.stack([sh[:, 0], new_sh[:, 0]])
        np.testing.assert_allclose(dc[1] * after[:, None], dc[0] * before[:, None], atol=1e-9)
        bands = np.stack([sh[:, 1:], new_sh[:, 1:]])
        np.testing.assert_allclose(bands[1] * after[:, None, None], bands[0] * before[:, None, None], atol=1e-9)


def test_equal_rotations_per_gaussian_equal_one_rotation_for_all():
    draws = np.random.default_rng(5)
    sh, vectors, light = draws.normal(size=(6, 1, 3)), 0.1 * draws.normal(size=(6, 3)), np.array([0.2, 0.1, 1.0])
    turn = rotations.normalize(draws.normal(size=4))
    one = shading.rebind(sh, vectors, np.ones(6), turn, light)
    each = shading.rebind(sh, vectors, np.ones(6), np.tile(turn, (6, 1)), light)
    for a, b in zip(one, each, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)

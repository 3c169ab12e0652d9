"""The sky is found where rays share a smooth colour over direction, and nowhere else."""

import numpy as np

from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.train.initialization import sky

UP = np.array([0.0, 0, 1])


def rays(count=3000, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def gradient(directions):
    """A sky that is warm at the horizon and blue above."""
    height = directions[:, 2:]
    return np.array([0.8, 0.7, 0.6]) * (1 - 0.5 * height**2) + np.array([-0.1, 0.0, 0.2]) * height


def test_a_gradient_sky_is_fitted_and_objects_in_front_are_not_sky():
    directions = rays()
    colors = gradient(directions)
    house = (directions[:, 0] > 0.6) & (directions[:, 2] < 0.5)
    colors[house] = np.random.default_rng(1).random((house.sum(), 3)) * 0.3
    candidates = directions[:, 2] > -0.1
    found = sky.fit(directions, colors, candidates, UP)
    assert found is not None
    coefficients, is_sky = found
    assert (is_sky == (candidates & ~house)).mean() > 0.99
    seen = spherical_harmonics.basis(directions[is_sky], sky.DEGREE) @ coefficients + 0.5
    assert np.abs(seen - colors[is_sky]).max() < sky.AGREES


def test_a_room_has_no_sky():
    directions = rays()
    colors = np.random.default_rng(2).random((len(directions), 3))
    assert sky.fit(directions, colors, directions[:, 2] > 0, UP) is None


def test_only_candidates_are_sky_and_few_are_no_evidence():
    directions = rays()
    colors = np.tile([0.3, 0.5, 0.9], (len(directions), 1))
    candidates = directions[:, 2] > 0.2
    found = sky.fit(directions, colors, candidates, UP)
    assert found is not None and (found[1] == candidates).all()
    few = np.zeros(len(directions), bool)
    few[:40] = True
    assert sky.fit(directions, colors, few, UP) is None

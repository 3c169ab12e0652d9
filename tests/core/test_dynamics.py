"""Points that move by twists of their own."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from r5dgs_core.motion import dynamics, rotations, se3

RNG = np.random.default_rng(0)
STATE = RNG.normal(size=(5, 12)) * [1, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 1]
V, W, A, E = np.split(STATE, 4, axis=-1)


def test_propagate_agrees_with_fine_steps():
    turns, moves = dynamics.propagate(STATE, 0.6, 1e-7)
    fine_turns, fine_moves = se3.integrate(W, V, E, A, np.full(5, 0.6), 4096)
    np.testing.assert_allclose(moves, fine_moves, atol=1e-6)
    assert rotations.angle_between(turns, fine_turns).max() < 1e-4


def test_points_at_rest_and_no_time_give_the_identity_to_the_bit():
    turns, moves = dynamics.propagate(np.zeros((3, 12)), 5.0, 1e-6)
    assert (turns == [1, 0, 0, 0]).all()
    assert (moves == 0).all()
    turns, moves = dynamics.propagate(STATE, 0.0, 1e-6)
    assert (turns == [1, 0, 0, 0]).all()
    assert (moves == 0).all()


def test_rk2_converges_with_order_two():
    _, exact = se3.integrate(W, V, E, A, np.full(5, 0.5), 4096)
    errors = [np.abs(dynamics.rk2(np.zeros((5, 3)), V, W, A, E, 0.5, h)[0] - exact).max() for h in (0.05, 0.025)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.25)


def test_rk2_does_not_depend_on_where_the_origin_is():
    shift = np.array([3.0, -2.0, 5.0])
    v, a = se3.recentre(W, V, E, A, -shift)
    near, turn = dynamics.rk2(np.zeros((5, 3)), V, W, A, E, 0.4, 0.05)
    far, same = dynamics.rk2(np.zeros((5, 3)) + shift, v, W, a, E, 0.4, 0.05)
    np.testing.assert_allclose(far - shift, near, atol=1e-12)
    np.testing.assert_array_equal(turn, same)


def test_rk2_serves_numpy_and_torch_alike():
    for duration in (0.3, -0.3, 0.0):
        arrays = dynamics.rk2(np.zeros((5, 3)), V, W, A, E, duration, 0.07)
        tensors = dynamics.rk2(torch.zeros(5, 3, dtype=torch.float64), *map(torch.tensor, (V, W, A, E)), duration, 0.07)
        for array, tensor in zip(arrays, tensors, strict=True):
            np.testing.assert_allclose(tensor.numpy(), array, atol=1e-14)


def test_the_last_step_is_shorter_so_that_the_time_is_met():
    # Constant velocity is exact at any step.
    state = np.zeros((1, 3)), np.ones((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3))
    points, _ = dynamics.rk2(*state, 1.0, 0.3)
    np.testing.assert_allclose(points, 1.0, atol=1e-15)

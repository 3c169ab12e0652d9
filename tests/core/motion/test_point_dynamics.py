"""Points that each move by their own twist."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
import torch

from r5dgs_core.motion import midpoint_path, point_dynamics, rotations, se3, twist_propagation

RNG = np.random.default_rng(0)
STATE = RNG.normal(size=(5, 12)) * [1, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 1]
V, W, A, E = np.split(STATE, 4, axis=-1)


def test_propagate_agrees_with_fine_steps():
    turns, moves = point_dynamics.propagate(STATE, 0.6, 1e-7)
    fine_turns, fine_moves = se3.integrate(W, V, E, A, np.full(5, 0.6), 4096)
    np.testing.assert_allclose(moves, fine_moves, atol=1e-6)
    assert rotations.angle_between(turns, fine_turns).max() < 1e-4


def test_points_at_rest_and_no_time_give_the_identity_to_the_bit():
    turns, moves = point_dynamics.propagate(np.zeros((3, 12)), 5.0, 1e-6)
    assert (turns == [1, 0, 0, 0]).all()
    assert (moves == 0).all()
    turns, moves = point_dynamics.propagate(STATE, 0.0, 1e-6)
    assert (turns == [1, 0, 0, 0]).all()
    assert (moves == 0).all()


def test_rk2_converges_with_order_two():
    w, e = np.array([0.0, 0.6, 2.9]), np.array([0.7, 0.2, 0.1])
    v, a, points = np.array([0.5, 0.3, -0.9]), np.array([-0.2, 0.8, 0.5]), np.random.default_rng(1).normal(size=(9, 3))
    quat, shift = se3.integrate(w, v, e, a, 2.0, 4096)
    exact = rotations.rotate(quat, points) + shift
    errors, angles = [], []
    for steps in (16, 64):
        places, turns = point_dynamics.rk2(points, v, w, a, e, 2.0, 2.0 / steps)
        errors.append(np.linalg.norm(places - exact, axis=-1).max())
        angles.append(rotations.angle_between(turns, quat).max())
    assert 0.5 * math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert 0.5 * math.log2(angles[0] / angles[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("angle", [0.05, 0.1, 0.5, 1.0, math.pi])
def test_midpoint_steps_enlarge_a_spinning_body_as_theory_predicts(angle):
    still, spin = np.zeros(3), np.array([0.0, 0.0, angle])
    points, _ = point_dynamics.rk2(np.array([1.0, 0.0, 0.0]), still, spin, still, still, 3.0, 1.0)
    assert np.linalg.norm(points) == pytest.approx((1 + angle**4 / 4) ** 1.5, rel=1e-9)


def test_midpoint_steps_that_are_too_long_warn_once(caplog):
    def play(angle, duration=1.0, kind=np.array):
        point_dynamics._warn_of_coarse_steps.cache_clear()
        caplog.clear()
        arrays = [kind(x) for x in (np.ones((2, 3)), np.zeros(3), np.array([0.0, 0.0, angle / 0.1]), np.zeros(3))]
        for _ in range(3):
            point_dynamics.rk2(*arrays, kind(np.zeros(3)), duration, 0.1)
        return len(caplog.records)

    with caplog.at_level(logging.WARNING):
        assert play(0.11) == 1
        assert "rad each" in caplog.text
        assert play(0.09) == 0
        assert play(5.0, duration=0.0) == 0
        assert play(5.0, kind=torch.tensor) == 0


@pytest.mark.parametrize(
    ("duration", "count"), [(1.0, 60), (10.0, 600), (1000.0, 60000), (0.01, 1), (0.0, 0), (-1.0, 60)]
)
def test_steps_are_counted_once(duration, count):
    sizes = point_dynamics.step_sizes(duration, point_dynamics.TRACE_STEP)
    assert len(sizes) == count
    assert math.fsum(sizes) == pytest.approx(duration, abs=1e-12)
    assert all(abs(h) <= point_dynamics.TRACE_STEP * (1 + 1e-9) for h in sizes)


@pytest.mark.parametrize(
    ("first", "last", "unit"),
    [(0, 0.25, 1), (0.3, 1, 1), (0, 0.2, 0.2), (0, 1.5, 1.5), (-0.5, 0.5, 1), (-0.1, 0.4, 0.5), (3, 3, 1), (2, 9, 7)],
)
def test_the_unit_of_time_is_one_or_the_observed_span(first, last, unit):
    assert point_dynamics.time_unit(first, last) == unit


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e200])
def test_one_bad_point_changes_no_bit_of_the_others(bad, caplog):
    still, others = STATE.copy(), [0, 1, 3, 4]
    still[2] = 0.0
    expected = point_dynamics.propagate(still, 0.8, 1e-6)
    for column in range(12):
        twist_propagation.warn_of_wild_dynamics.cache_clear()
        caplog.clear()
        spoiled = STATE.copy()
        spoiled[2, column] = bad
        with caplog.at_level(logging.WARNING):
            turns, moves = point_dynamics.propagate(spoiled, 0.8, 1e-6)
        np.testing.assert_array_equal(turns[others], expected[0][others])
        np.testing.assert_array_equal(moves[others], expected[1][others])
        assert np.isfinite(turns[2]).all() and np.isfinite(moves[2]).all()
        if not math.isfinite(bad):
            assert (turns[2] == [1, 0, 0, 0]).all() and (moves[2] == 0).all()
            assert "1 of 5 points" in caplog.text, column


def test_huge_dynamics_stay_finite_in_single_precision():
    for column in range(6):  # velocity and spin
        state = np.zeros((1, 12), np.float32)
        state[0, column] = 1e30
        for part in point_dynamics.propagate(state, 0.8, 1e-6):
            assert np.isfinite(part.astype(np.float32)).all()


def test_rk2_does_not_depend_on_where_the_origin_is():
    shift = np.array([3.0, -2.0, 5.0])
    v, a = se3.recentre(W, V, E, A, -shift)
    near, turn = point_dynamics.rk2(np.zeros((5, 3)), V, W, A, E, 0.4, 0.05)
    far, same = point_dynamics.rk2(np.zeros((5, 3)) + shift, v, W, a, E, 0.4, 0.05)
    np.testing.assert_allclose(far - shift, near, atol=1e-12)
    np.testing.assert_array_equal(turn, same)


def test_rk2_serves_numpy_and_torch_alike():
    for duration in (0.3, -0.3, 0.0):
        arrays = point_dynamics.rk2(np.zeros((5, 3)), V, W, A, E, duration, 0.07)
        tensors = point_dynamics.rk2(
            torch.zeros(5, 3, dtype=torch.float64), *map(torch.tensor, (V, W, A, E)), duration, 0.07
        )
        for array, tensor in zip(arrays, tensors, strict=True):
            np.testing.assert_allclose(tensor.numpy(), array, atol=1e-14)


def test_the_last_step_is_shortened_to_reach_the_time():
    # Constant velocity is exact at any step.
    state = np.zeros((1, 3)), np.ones((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3))
    points, _ = point_dynamics.rk2(*state, 1.0, 0.3)
    np.testing.assert_allclose(points, 1.0, atol=1e-15)


def test_a_diverging_path_keeps_its_last_finite_position(monkeypatch):
    monkeypatch.setattr(midpoint_path, "MAX_STEPS", 2000)
    start = np.zeros((2, 3))
    v, w = np.array([[0.1, 0, 0], [0.1, 0, 0]]), np.array([[0, 0, 400.0], [0, 0, 0.5]])
    path = midpoint_path.MidpointPath(start, v, w, 0 * v, np.array([[300.0, 0, 0], [0, 0, 0]]), 1 / 60)
    points, quats = path.at(1000.0)
    assert np.isfinite(points).all() and np.isfinite(quats).all()
    alone, _ = midpoint_path.MidpointPath(start[1:], v[1:], w[1:], 0 * v[1:], 0 * v[1:], 1 / 60).at(1000.0)
    np.testing.assert_array_equal(alone[0], points[1])
    np.testing.assert_array_equal(path.at(1e6)[0], path.at(midpoint_path.MAX_STEPS / 60)[0])

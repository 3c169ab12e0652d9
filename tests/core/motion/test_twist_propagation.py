"""Many points at any time: steps by need, closed forms, random access."""

from __future__ import annotations

import numpy as np
import pytest

from r5dgs_core.motion import midpoint_path, point_dynamics, rotations, se3, twist_propagation

RNG = np.random.default_rng(0)


def points(count: int) -> np.ndarray:
    """Dynamics of all kinds: general, sliding, constant twist, constant spin, parallel rates, resting. [N, 12]"""
    state = RNG.normal(size=(count, 12)) * np.repeat([1.0, 3.0, 1.0, 2.0], 3)
    state[0::6, 3:6], state[0::6, 9:] = 0.0, 0.0
    state[1::6, 6:] = 0.0
    state[2::6, 9:] = 0.0
    state[3::6, 9:] = 2 * state[3::6, 3:6]
    state[4::6] = 0.0
    return state


@pytest.mark.parametrize("count", [1, 7, 60])
@pytest.mark.parametrize("duration", [0.01, 0.4, 1.5, -0.7])
def test_points_stay_within_the_tolerance(count, duration):
    state, tolerance = points(count), 1e-5
    quats, moves = twist_propagation.Propagator(state, tolerance, radius=1.0).rows_of(duration)
    v, w, a, e = np.split(state, 4, axis=-1)
    fine, exact = se3.integrate(w, v, e, a, np.full(count, duration), 2048)
    assert np.linalg.norm(moves - exact, axis=-1).max() < tolerance
    assert rotations.angle_between(quats, fine).max() < tolerance
    still = (state == 0).all(-1)
    assert (quats[still] == [1, 0, 0, 0]).all() and (moves[still] == 0).all()


def test_closed_forms_need_no_tolerance():
    state = points(60)
    state = state[(state[:, 9:] == 0).all(-1)]
    v, w, a, _ = np.split(state, 4, axis=-1)
    quats, moves = twist_propagation.Propagator(state, 1e3).rows_of(2.5)
    expected, exact = se3.accelerated_spin(w, v, a, np.full(len(state), 2.5))
    np.testing.assert_allclose(moves, exact, atol=1e-12)
    np.testing.assert_allclose(quats, expected, atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.5, np.pi, 2 * np.pi, 30.0])
def test_precision_is_kept_near_zero_rotation(turn):
    w, v = np.array([[turn], [0.0], [0.0]]), np.array([[0.3], [-1.0], [2.0]])
    quats, moves = twist_propagation._exp(np.concatenate([w, v]))
    expected, exact = se3.exp(w[:, 0], v[:, 0])
    np.testing.assert_allclose(moves[:, 0], exact, rtol=0, atol=1e-14 * max(1, turn))
    np.testing.assert_allclose(quats[:, 0], expected, atol=1e-15)


def test_times_may_have_any_order_and_points_any_number():
    state, times = points(50), [0.5, 0.1, 0.9, 0.5]
    kept = twist_propagation.Propagator(state, 1e-6)
    for t in times:
        for one, other in zip(kept.rows_of(t), twist_propagation.Propagator(state, 1e-6).rows_of(t), strict=True):
            np.testing.assert_array_equal(one, other)
    quats, moves = twist_propagation.Propagator(np.zeros((0, 12)), 1e-6).rows_of(1.0)
    assert quats.shape == (0, 4) and moves.shape == (0, 3)


def test_points_beyond_one_chunk_are_all_computed(monkeypatch):
    state = points(40)
    whole = twist_propagation.Propagator(state, 1e-8).rows_of(0.6)
    monkeypatch.setattr(twist_propagation, "CHUNK", 7)
    for one, other in zip(twist_propagation.Propagator(state, 1e-8).rows_of(0.6), whole, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)


def test_kept_midpoint_steps_are_those_of_rk2_to_the_bit():
    v, w, a, e = RNG.normal(size=(4, 3, 3))
    path = midpoint_path.MidpointPath(np.zeros((3, 3)), v, w, a, e, 1 / 60)
    for t in (0.21, 0.0, 0.01, 1 / 60, 0.5, 0.05):
        for one, other in zip(path.at(t), point_dynamics.rk2(np.zeros((3, 3)), v, w, a, e, t, 1 / 60), strict=True):
            np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="duration"):
        path.at(-0.1)

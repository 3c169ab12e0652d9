"""Errors that no candidate shows: exact pendulums leave their fitted swings, short tracks hide hits."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import candidates, law_errors

AHEAD = np.linspace(0, 1 / 3, 6)[1:]
NOISE = candidates.Noise(0.01, 0.01)
AXIS, ARM = np.array([0.6, 0.8, 0.0]), 3.0


def pendulum(tau, start, pace):
    """Poses, relative to that at t_max, of a pendulum that starts at rest at an angle; pace of small swings."""
    solved = solve_ivp(
        lambda _, s: [s[1], -(pace**2) * np.sin(s[0])], (-1, 1), [start, 0.0], rtol=1e-10, dense_output=True
    )
    angles = solved.sol(np.append(tau, 0.0))[0]
    quats = rotations.rotvecs_to_quats(angles[:, None] * AXIS)
    hanging = rotations.rotate(quats, np.array([0.0, 0.0, -ARM]))
    return rotations.multiply(quats[:-1], rotations.conjugate(quats[-1:])), hanging[:-1] - hanging[-1]


def fitted(name, track):
    law = dataclasses.replace(candidates.BY_NAME[name], window=track.window)
    return candidates.solve(law, track, NOISE, enough=1e-12, steps=60)


def size(place, turn):
    return np.sqrt(place + 2 / 3 * turn)


@pytest.mark.parametrize("start", [0.7, 1.1])
@pytest.mark.parametrize("pace", [5.0, 7.0])
def test_a_pendulum_leaves_its_fitted_swing_by_the_stated_error(start, pace):
    tau = np.linspace(-1, 0, 15)
    track = PoseTrack(tau, *pendulum(tau, start, pace), np.ones(15))
    solution = fitted("pendulum", track)
    quats, d = solution.candidate.path(solution.theta, AHEAD)
    true_quats, true = pendulum(AHEAD, start, pace)
    actual = size(((true - d) ** 2).sum(-1), rotations.angle_between(true_quats, quats) ** 2)
    stated = size(*law_errors.squares(solution, track, NOISE, AHEAD))
    assert np.linalg.norm(stated - actual) < 0.3 * np.linalg.norm(actual)  # higher orders


def swinging(size, decay=None):
    """Swing about a fixed axis with known parameters."""
    law = candidates.BY_NAME["pendulum" if decay is None else "damped pendulum"]
    values = {"r": np.zeros(3), "e": np.zeros(3), "swing": size * AXIS, "phase": np.array([0.4]), "u": np.ones(3)}
    values |= {"pace": np.zeros(1)} | ({} if decay is None else {"decay": np.array([math.log(decay)])})
    return candidates.FittedCandidate(law, law.pack(values), np.eye(law.parameters), np.zeros((7, 6)), np.ones(7))


@pytest.mark.parametrize("decay", [None, 0.8])
def test_the_harmonic_turns_about_the_axis_by_its_angle_since_t_max(decay):
    solution, tau = swinging(0.9, decay), np.linspace(-1, 1, 24)
    frequency = float(solution.candidate.window.frequency(np.zeros(1))[0])
    shrunk = 0.9 * np.exp(-(decay or 0.0) * tau)
    expected = (shrunk**3 * np.sin(3 * (frequency * tau + 0.4)) - 0.9**3 * np.sin(1.2)) / 192
    found = law_errors._harmonic(solution, tau)
    np.testing.assert_allclose(found[:, 3:], expected[:, None] * AXIS, atol=1e-6)


def test_laws_without_a_swing_have_no_harmonic():
    tau = np.linspace(-1, 0, 15)
    track = PoseTrack(tau, *pendulum(tau, 0.8, 6.0), np.ones(15))
    np.testing.assert_array_equal(law_errors.squares(fitted("hinge", track), track, NOISE, AHEAD), 0)
    still = swinging(0.0)
    np.testing.assert_array_equal(law_errors.squares(still, track.rows(slice(-7, None)), NOISE, AHEAD), 0)


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_a_hit_in_a_track_without_fitted_breaks_is_as_far_off_as_stated(count):
    tau = np.linspace(-1, 0, count)
    v, w = np.array([1.0, -2.0, 0.5]), np.array([0.0, 0.3, 0.8])
    before = np.minimum(tau - tau[-2], 0)[:, None]  # other rates up to the last but one pose
    quats = rotations.multiply(rotations.rotvecs_to_quats(before * v), rotations.rotvecs_to_quats(tau[:, None] * w))
    track = PoseTrack(tau, quats, tau[:, None] * v + before * w, np.ones(count))
    solution = fitted("translation + spin", track)
    place, turn = law_errors.squares(solution, track, NOISE, AHEAD)
    if count >= law_errors.SHORT:
        np.testing.assert_array_equal((place, turn), 0)
    else:
        predicted, d = solution.candidate.path(solution.theta, AHEAD)
        truth = rotations.rotvecs_to_quats(AHEAD[:, None] * w)
        np.testing.assert_allclose(place, ((AHEAD[:, None] * v - d) ** 2).sum(-1), atol=1e-12)
        np.testing.assert_allclose(turn, rotations.angle_between(truth, predicted) ** 2, atol=1e-12)

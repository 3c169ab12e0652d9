import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion_fit import model_selection
from tests.support.problems import RADIUS, SIZE, T_MAX

TIMES = np.linspace(0, T_MAX, 15)
STEP = TIMES[1] - TIMES[0]
SIGMA = 0.005 * SIZE, np.radians(0.8)
V, W, G = np.array([0.9, -0.3, 0.4]), np.array([1.0, -0.5, 2.0]), np.array([0.0, 0.0, -4.0])
TURN = np.radians(30) * np.array([0.6, 0.0, 0.8])


def steady(t):
    return rotations.rotvecs_to_quats(W * t[:, None]), V * t[:, None]


def ballistic(t):
    return rotations.rotvecs_to_quats(W * t[:, None]), V * t[:, None] + 0.5 * G * t[:, None] ** 2


def fitted(path, rows, seed=0):
    """Fit of noisy poses, some of them turned, and the errors of the rotation and the place at t = 1."""
    rng = np.random.default_rng(seed)
    quats, d = path(TIMES)
    quats = rotations.multiply(rotations.rotvecs_to_quats(SIGMA[1] * rng.normal(size=(15, 3))), quats)
    d = d + SIGMA[0] * rng.normal(size=(15, 3))
    quats[rows] = rotations.multiply(quats[rows], rotations.rotvecs_to_quats(TURN))
    relative = rotations.multiply(quats, rotations.conjugate(quats[-1]))
    fit = model_selection.fit(TIMES, relative, d - d[-1], radius=RADIUS)
    turn, move = models.evaluate(fit.model, 1.0 - T_MAX)
    true_quat, true = (x[0] for x in path(np.ones(1)))
    angle = rotations.angle_between(rotations.multiply(turn, quats[-1]), true_quat)
    return fit, np.degrees(float(angle)), np.linalg.norm(d[-1] + move - true) / SIZE


def wrong(fit):
    """Numbers of the poses whose rotations a fit calls slipped."""
    return [n for n, time in enumerate(TIMES[:15]) if any(first < time < last for first, last in fit.slipped)]


@pytest.mark.default_cases("steady-3", "ballistic-5")
@pytest.mark.parametrize("count", [1, 3, 5])
@pytest.mark.parametrize("path", [steady, ballistic], ids=["steady", "ballistic"])
def test_a_slip_of_the_last_poses_is_no_impact_and_does_not_turn_the_prediction(path, count):
    fit, angle, distance = fitted(path, slice(15 - count, 15))
    assert fit.history.events == ()
    if count > 1:  # a single pose may also count as an outlier
        np.testing.assert_allclose(fit.slips, TIMES[-count] - 0.5 * STEP)
        assert wrong(fit) == list(range(15 - count, 15))
    assert angle < 4
    assert distance < 0.05


def test_a_slip_of_the_first_poses_keeps_the_later_ones():
    fit, angle, distance = fitted(steady, slice(0, 4))
    np.testing.assert_allclose(fit.slips, TIMES[4] - 0.5 * STEP)
    assert wrong(fit) == [0, 1, 2, 3]
    assert angle < 3
    assert distance < 0.03


def test_a_slip_that_ends_in_the_window_has_two_times():
    fit, angle, _ = fitted(steady, slice(6, 10))
    np.testing.assert_allclose(fit.slips, TIMES[[6, 10]] - 0.5 * STEP)
    assert wrong(fit) == [6, 7, 8, 9]
    assert angle < 3


def test_tracks_without_a_slip_have_none():
    fit, _, _ = fitted(steady, slice(0, 0))
    assert fit.slips == () and fit.slipped == ()

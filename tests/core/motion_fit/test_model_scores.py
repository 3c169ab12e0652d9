import dataclasses
import warnings

import numpy as np
import pytest

from r5dgs_core.motion import models
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import candidates, model_scores
from tests.support import problems

TRUTH = models.MotionModel("translation", velocity=[0.8, -0.5, 0.3])
SIGMA = 0.01


def fitted(rng, correlation, times):
    """Fit to a straight motion, its track and noise, the error of the velocity and its variance without a factor."""
    quats, d, _, _ = problems.observe(TRUTH, times, rng, SIGMA, SIGMA, correlation)
    track = PoseTrack(times - times[-1], quats, d, np.ones(len(times)))
    noise = candidates.Noise(SIGMA, SIGMA)
    law = dataclasses.replace(candidates.BY_NAME["translation + spin"], window=track.window)
    solution = candidates.solve(law, track, noise)
    rows = law.parts(np.arange(law.parameters))["v"]
    return solution, track, noise, solution.theta[rows] - TRUTH.velocity, np.diag(solution.inverse)[rows]


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_the_covariance_covers_errors_of_parameters_under_correlated_noise(correlation):
    rng, times = np.random.default_rng(3), np.linspace(0, 1, 15)
    squares, earlier = [], []
    for _ in range(60):
        solution, track, noise, error, inverse = fitted(rng, correlation, times)
        least = model_scores.NoiseLevel.of([solution])
        squares.append(error**2 / (model_scores.covariance_factor(solution, track, noise, least) * inverse))
        earlier.append(error**2 / (least.variance * inverse))
    assert 0.2 < np.mean(squares) < 1.2
    assert correlation == 0 or np.mean(earlier) > 1.3


def test_the_variance_covers_uneven_times_and_is_never_below_that_of_the_evidence():
    times = np.sort(np.random.default_rng(1).uniform(0, 1, 15))
    solution, track, noise, _, _ = fitted(np.random.default_rng(2), 0.7, times)
    least = model_scores.NoiseLevel.of([solution])
    assert np.isfinite(model_scores.covariance_factor(solution, track, noise, least))
    large = dataclasses.replace(least, level=1e6)
    assert model_scores.covariance_factor(solution, track, noise, large) == large.variance


def test_two_poses_have_the_variance_of_the_evidence():
    times = np.array([0.0, 1.0])
    quats, d, _, _ = problems.observe(TRUTH, times, np.random.default_rng(0), SIGMA, SIGMA)
    track, noise = PoseTrack(times - 1, quats, d, np.ones(2)), candidates.Noise(SIGMA, SIGMA)
    solution = candidates.solve(candidates.BY_NAME["translation + spin"], track, noise)
    least = model_scores.NoiseLevel(2, 1.0, 1.0)
    assert model_scores.covariance_factor(solution, track, noise, least) == 1.0


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_exact_poses_that_leave_a_direction_undetermined_give_a_finite_variance(share):
    times = np.linspace(0, 1, 15)
    spin = models.MotionModel("ballistic_spin", angular_velocity=[1, 1, 0])
    quats, d, _, _ = problems.observe(spin, times, np.random.default_rng(0))
    track, noise = PoseTrack(times - 1, quats, d, np.ones(15)), candidates.Noise(1e-9, 1e-9)
    law = dataclasses.replace(candidates.BY_NAME["precession"], window=track.window)
    w = spin.angular_velocity
    # Only the sum of p and s affects a spin about a fixed axis.
    start = law.pack({"r": 0 * w, "e": 0 * w, "p": share * w, "s": (1 - share) * w, "u": 0 * w})
    solution = candidates.solve(law, track, noise, [start])
    least = model_scores.NoiseLevel.of([solution])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(model_scores.covariance_factor(solution, track, noise, least))

import dataclasses
import warnings

import numpy as np
import pytest
from scipy.linalg import block_diag

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import candidates, model_scores, slips
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


@pytest.mark.parametrize("outlier", [3, 7, 13])
def test_one_outlier_changes_the_covariance_factor_as_little_as_a_missing_pose(outlier):
    times = np.linspace(0, 1, 15)
    quats, d, _, _ = problems.observe(TRUTH, times, np.random.default_rng(5), SIGMA, SIGMA)
    noise, least = candidates.Noise(SIGMA, SIGMA), model_scores.NoiseLevel(15, 1e-6, 1.0)
    factors = []
    for shift, kept in ((15 * SIGMA, times >= 0), (0.0, np.arange(15) != outlier)):
        moved = d + shift * (np.arange(15) == outlier)[:, None]
        track = PoseTrack(times[kept] - 1, quats[kept], moved[kept], np.ones(kept.sum()))
        law = dataclasses.replace(candidates.BY_NAME["translation + spin"], window=track.window)
        solution = candidates.solve(law, track, noise)
        factors.append(model_scores.covariance_factor(solution, track, noise, least))
    assert factors[0] == pytest.approx(factors[1], rel=0.1)


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


def with_residuals(residuals, name="translation", weights=None):
    """Solution of a law with given residuals [S, 6]."""
    law = candidates.BY_NAME[name]
    weights = np.ones(len(residuals)) if weights is None else weights
    size = law.parameters
    return candidates.FittedCandidate(law, np.zeros(size), np.eye(size), np.asarray(residuals, float), weights)


def cauchy_loss(residuals):
    return 24 * np.log(1 + (residuals**2).sum(1) / 24).sum()


def correlated(rng, rho, shape):
    """Noise of unit variance whose neighbours along the first axis have the correlation rho."""
    noise = rng.normal(size=shape)
    for i in range(1, len(noise)):
        noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * noise[i]
    return noise


def test_the_score_adds_the_scaled_loss_the_parameters_and_the_choices():
    residuals = np.random.default_rng(0).normal(size=(10, 6))
    level = model_scores.NoiseLevel(count=10, level=2.0, inflation=3.0)
    smooth = with_residuals(residuals)
    expected = cauchy_loss(residuals) / (2 * 3) + 9 * np.log(6 * 10 / 3)
    assert level.score(smooth) == pytest.approx(expected)
    slip = slips.Slip("slip", "translation", ("v", "b"), start=2, stop=5, low=-0.9, high=-0.5)
    slipped = dataclasses.replace(smooth, candidate=slip)
    assert level.score(slipped) == pytest.approx(expected + 3 * np.log(6 * 10 / 3) + 2 * 2 * np.log(10))


def test_the_noise_level_is_the_least_loss_per_free_number():
    rng = np.random.default_rng(1)
    coarse, fine = 2 * rng.normal(size=(20, 6)), 0.7 * rng.normal(size=(20, 6))
    solutions = [with_residuals(coarse, "static"), with_residuals(fine)]
    expected = cauchy_loss(fine) / (6 * 20 - 9)
    assert model_scores.NoiseLevel.of(solutions).level == pytest.approx(expected)
    assert model_scores.NoiseLevel.of(solutions, least=3.0).level == 3.0
    parts = model_scores.NoiseLevel.of_parts(solutions, 0.0)
    assert parts.count == 40
    assert parts.level == pytest.approx((cauchy_loss(coarse) + cauchy_loss(fine)) / (6 * 40 - 6 - 9))


def test_the_noise_is_as_correlated_as_that_of_the_candidate_with_the_best_score():
    signs = np.where(np.arange(20) % 2, 1.0, -1.0)[:, None] * np.ones(6)
    # Six more parameters cost 6 log 120 = 29; in units of the least noise level, 0.1, the loss falls by 55.
    simple, better = with_residuals(np.full((20, 6), 0.37), "static"), with_residuals(0.3 * signs, "translation + spin")
    assert model_scores.NoiseLevel.of([simple, better]).inflation == pytest.approx(1.0)
    # Here it falls by 4 only.
    simple = with_residuals(np.full((20, 6), 0.306), "static")
    assert model_scores.NoiseLevel.of([simple, better]).inflation > 5


@pytest.mark.parametrize("rho", [0.3, 0.6])
def test_the_inflation_is_the_factor_on_the_variance_of_a_mean_of_correlated_noise(rho):
    count = 500
    noise = correlated(np.random.default_rng(2), rho, (count, 6))
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    expected = (rho**lags).sum() / count
    assert model_scores.NoiseLevel.of([with_residuals(noise)]).inflation == pytest.approx(expected, rel=0.1)


def test_the_inflation_allows_for_the_correlation_that_a_fit_removes():
    rho, count = 0.4, 15
    line = np.stack([np.ones(count), np.arange(count)], -1)
    rng, parts = np.random.default_rng(3), []
    for _ in range(100):
        noise = correlated(rng, rho, (count, 6))
        parts.append(with_residuals(noise - line @ np.linalg.lstsq(line, noise, rcond=None)[0], "translation + spin"))
    products = sum((s.residuals[1:] * s.residuals[:-1]).sum() for s in parts)
    biased = products / sum((s.residuals**2).sum() for s in parts)
    inflation = model_scores.NoiseLevel.of_parts(parts, 0.0).inflation
    assert abs((inflation - 1) / (inflation + 1) - rho) < 0.5 * abs(biased - rho)


def test_the_covariance_factor_averages_generalized_least_squares_over_the_correlation():
    rng, count = np.random.default_rng(4), 12
    times = np.sort(rng.uniform(-1, 0, count))
    times -= times[-1]
    d = times[:, None] * TRUTH.velocity + SIGMA * correlated(rng, 0.5, (count, 3))
    quats = rotations.rotvecs_to_quats(1e-6 * rng.normal(size=(count, 3)))
    track = PoseTrack(times, quats, d, rng.uniform(0.5, 1.5, count))
    noise = candidates.Noise(SIGMA, 1e-6)
    law = candidates.BY_NAME["translation"]
    solution = candidates.solve(law, track, noise)
    assert solution is not None

    # Small rotations make the model linear: rotation = r, displacement = e + v t, in units of the noise.
    rotvecs = 2 * quats[:, 1:]
    observed = np.concatenate([rotvecs / 1e-6, d / SIGMA], 1).T.ravel()
    line = np.stack([np.ones(count), times], -1)
    columns = block_diag(*[np.ones((count, 1))] * 3, *[line] * 3)
    squares = (solution.residuals**2).sum(1)
    scale = np.tile(1 / np.sqrt(track.weights / (1 + squares / candidates.SOFTNESS)), 6)
    steps = np.abs(np.subtract.outer(times, times)) / np.median(np.diff(times))
    likelihoods, variances = [], []
    for rho in model_scores._RHOS:
        covariance = np.kron(np.eye(6), rho**steps) * np.outer(scale, scale)
        inverse = np.linalg.inv(covariance)
        normal = columns.T @ inverse @ columns
        rest = observed - columns @ np.linalg.solve(normal, columns.T @ inverse @ observed)
        loss, free = rest @ inverse @ rest, 6 * count - 9
        logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(normal)[1] + free * np.log(loss)
        likelihoods.append(-0.5 * logs + np.log(1 - rho))  # the prior
        variances.append(loss / free * (1 + rho) / (1 - rho))
    shares = np.exp(np.array(likelihoods) - max(likelihoods))
    least = model_scores.NoiseLevel(count, 1e-6, 1.0)
    found = model_scores.covariance_factor(solution, track, noise, least)
    assert found == pytest.approx(shares @ variances / shares.sum(), rel=1e-4)

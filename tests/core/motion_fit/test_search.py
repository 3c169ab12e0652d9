import dataclasses
import math

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import breaks, candidates, model_scores, search
from r5dgs_core.motion_fit.model_scores import NoiseLevel

NOISE = candidates.Noise(0.01, 0.01)


def with_residuals(residuals, name="translation", weights=None):
    """Solution of a law with given residuals [S, 6]."""
    law = candidates.BY_NAME[name]
    weights = np.ones(len(residuals)) if weights is None else weights
    size = law.parameters
    return candidates.FittedCandidate(law, np.zeros(size), np.eye(size), np.asarray(residuals, float), weights)


def observed(rng, count=15, v=0.0, scale=1.0):
    """Noisy poses of a body that moves at velocity v along x; ``scale`` is that of the noise, in units of `NOISE`."""
    tau = np.linspace(-1, 0, count)
    noise = 0.01 * scale * rng.normal(size=(2, count, 3))
    quats = rotations.rotvecs_to_quats(noise[1])
    return PoseTrack(tau, quats, v * tau[:, None] * [1, 0, 0] + noise[0], np.ones(count))


def test_residuals_of_equal_size_have_their_square_per_free_number_as_variance():
    residuals = np.random.default_rng(0).choice([-1.0, 1.0], size=(20, 6)) * [2, 2, 2, 0.5, 0.5, 0.5]
    weights = np.random.default_rng(1).uniform(0.5, 1.5, 20)
    free = 1 - 9 / 120
    found = search._residual_variances(
        [with_residuals(3 * residuals, "static"), with_residuals(residuals, weights=weights)]
    )
    np.testing.assert_allclose(found, (4 / free, 0.25 / free))


def test_an_outlier_hardly_changes_the_variance_of_the_residuals():
    residuals = np.random.default_rng(2).normal(size=(200, 6))
    place, turn = search._residual_variances([with_residuals(residuals)])
    residuals[7] *= 1000
    again = search._residual_variances([with_residuals(residuals)])
    np.testing.assert_allclose(again, (place, turn), rtol=0.1)
    weights = np.where(np.arange(200) == 7, 1e-9, 1.0)
    np.testing.assert_allclose(
        search._residual_variances([with_residuals(residuals, weights=weights)]), (place, turn), rtol=0.03
    )


def test_the_misfit_is_the_variance_of_normal_residuals_of_the_best_solution():
    rng = np.random.default_rng(3)
    residuals = rng.normal(size=(4000, 6)) * [3, 3, 3, 2, 2, 2]
    found = search._misfit([with_residuals(5 * residuals), with_residuals(residuals)])
    np.testing.assert_allclose(found, (9, 4), rtol=0.06)
    residuals[:1000] *= 100
    np.testing.assert_array_less(search._misfit([with_residuals(residuals)]), (20, 9))


@pytest.mark.parametrize(("v", "name"), [(0.0, "static"), (1.0, "translation + spin")])
def test_a_plain_fit_has_only_the_parameters_that_the_motion_needs(v, name):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        # Noise smaller than assumed, so that losses hardly differ.
        found = search._plain(observed(rng, v=v, scale=0.3), NOISE)
        assert found.candidate.name == name


@pytest.mark.parametrize(("count", "tried"), [(7, False), (8, True)])
def test_breaks_are_tried_for_eight_poses_or_more(count, tried):
    track = observed(np.random.default_rng(4), count, v=1.0)
    laws = [dataclasses.replace(candidates.STATIC, window=track.window)]
    found, broken, _ = search._try_all(laws, track, NOISE, try_breaks=True)
    assert len(found) == 1
    assert {s.candidate.name for s in broken} == (set(breaks.BREAKS) if tried else set())
    assert search._try_all(laws, track, NOISE, try_breaks=False)[1:] == ([], [])


def test_the_excess_of_parts_is_the_difference_of_scores_at_their_noise_level():
    rng = np.random.default_rng(5)
    residuals = rng.normal(size=(20, 6))
    parts = [with_residuals(residuals[:8], "static"), with_residuals(residuals[8:])]
    whole = with_residuals(2 * residuals, "translation + spin")
    level = NoiseLevel.of_parts(parts, 0.5)
    sums = sum(s.loss for s in parts) / level.variance + (6 + 9) * math.log(120 / level.inflation) + 2 * math.log(20)
    expected = sums - whole.loss / level.variance - 12 * math.log(120 / level.inflation)
    assert search._excess(parts, whole, 0.5) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("simple", "other", "chosen"),
    [(2.9, 0.5, "static"), (3.1, 0.5, "translation"), (5.8, 2.0, "static"), (6.2, 2.0, "translation")],
)
def test_a_law_whose_predictions_miss_three_times_the_expected_or_best_error_is_rejected(
    monkeypatch, simple, other, chosen
):
    errors = {"static": simple, "translation": other}
    monkeypatch.setattr(search.backtest, "relative_error", lambda solution, *_: errors[solution.candidate.name])
    laws = [with_residuals(np.zeros((15, 6)), name) for name in errors]
    # Of nearly equal scores, so that the law with fewer parameters is preferred.
    laws[0] = with_residuals(np.full((15, 6), 0.3), "static")
    level, track = NoiseLevel(15, 1.0, 1.0), observed(np.random.default_rng(8))
    assert abs(level.score(laws[0]) - level.score(laws[1])) < model_scores.NEAR
    assert search._simplest(laws, level, track, NOISE).candidate.name == chosen


@pytest.mark.parametrize(("height", "evidence"), [(0.057, (7, 10)), (0.062, (10, 14))])
def test_a_law_with_events_needs_strong_evidence_over_a_smooth_one(height, evidence):
    track = observed(np.random.default_rng(0), v=1.0)
    phase = (track.tau + 1.1) % 0.4
    track.displacements[:, 2] += height * phase * (0.4 - phase) / 0.04  # elastic bounces
    laws = tuple(
        dataclasses.replace(candidates.BY_NAME[name], window=track.window) for name in ("translation", "bounces")
    )
    found = search.select(track, laws, NOISE, try_breaks=False, up=None)
    smooth, bounces = (found.noise_level.score(s) for s in found.solutions)
    assert evidence[0] < smooth - bounces < evidence[1]
    assert found.chosen.candidate.name == ("bounces" if smooth - bounces > 10 else "translation")


def test_a_small_jump_of_the_rates_needs_evidence_with_the_inverse_square_of_its_size():
    law = breaks.BreakCandidate("impact", "ballistic_spin", ("v", "w", "dv", "dw", "c"), low=-0.4, high=-0.3)
    zero = np.zeros(3)
    for jump, factor in ((0.3, 1), (0.15, 1), (0.075, 4), (0.05, 9)):
        parts = {"r": zero, "e": zero, "v": np.array([0, 2.0, 0]), "w": zero, "dw": zero, "c": np.zeros(1)}
        theta = law.pack(parts | {"dv": np.array([0, -2 * jump, 0])})
        solution = candidates.FittedCandidate(law, theta, np.eye(len(theta)), np.zeros((15, 6)), np.ones(15))
        assert law.jump(theta) == pytest.approx(jump)
        assert search._margin(solution, with_residuals(np.zeros((15, 6)))) == pytest.approx(
            model_scores.STRONG * factor
        )


def test_a_refit_to_finer_noise_has_the_residuals_of_its_own_poses():
    rng, finer = np.random.default_rng(6), candidates.Noise(0.005, 0.002)
    track = observed(rng, v=1.0, scale=0.2)
    solutions = [candidates.solve(candidates.BY_NAME[name], track, NOISE) for name in ("static", "translation")]
    best = solutions[1]
    refined = search._refined(solutions, best, track, NOISE, finer)
    for solution in refined:
        expected = candidates.residuals(solution.candidate, solution.theta, track, finer)
        np.testing.assert_allclose(solution.residuals, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(refined[0].theta, solutions[0].theta)  # hopeless: only rescaled


@pytest.mark.parametrize("deviation", [0.8, 1.2])
def test_a_frequency_is_determined_if_its_standard_deviation_is_at_most_a_quarter(deviation):
    spring, level = candidates.BY_NAME["spring"], NoiseLevel(15, 2.0, 3.0)
    window, row = spring.window, spring.rows["pace"][0]
    theta = np.random.default_rng(7).normal(size=spring.parameters)
    theta[row] = logit = 0.3
    frequency = window.frequency(np.array(logit))
    step = 1e-6
    slope = float(window.frequency(np.array(logit + step)) - window.frequency(np.array(logit - step))) / (2 * step)
    sigma = deviation * search.FREQUENCY_ERROR * frequency / slope  # of the parameter
    normal = np.eye(len(theta))
    normal[row, row] = level.variance / sigma**2
    solution = candidates.FittedCandidate(spring, theta, normal, np.zeros((15, 6)), np.ones(15))
    assert search._determined(solution, level) == (deviation < 1)


def test_two_poses_follow_the_simplest_exact_law():
    track = PoseTrack(np.array([-1.0, 0]), rotations.identity(2), np.array([[-1.0, 0, 0], [0, 0, 0]]), np.ones(2))
    assert search.select_from_few_poses(track, candidates.FAMILY).chosen.candidate.name == "translation"
    still = dataclasses.replace(track, displacements=0.001 * track.displacements)
    assert search.select_from_few_poses(still, candidates.FAMILY).chosen.candidate.name == "static"

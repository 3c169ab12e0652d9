import dataclasses
import math

import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.history import Band
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import band, breaks, candidates, fitted_motion, search, slips
from r5dgs_core.motion_fit.model_scores import NoiseLevel

AHEAD = np.linspace(0, 1, 5)
FIXED = 1e12  # entry of the normal matrix of a known parameter


def solved(law, theta, normal=None, residuals=None):
    """Solution of a law with given parameters, known exactly unless ``normal`` is given."""
    normal = FIXED * np.eye(len(theta)) if normal is None else normal
    residuals = np.zeros((7, 6)) if residuals is None else residuals
    return candidates.FittedCandidate(law, theta, normal, residuals, np.ones(len(residuals)))


def moving(v=(0, 0, 0), w=(0, 0, 0), residuals=None):
    law = candidates.BY_NAME["translation + spin"]
    parts = {"r": np.zeros(3), "e": np.zeros(3), "v": np.array(v, float), "w": np.array(w, float)}
    return solved(law, law.pack(parts), residuals=residuals)


LAWS = {
    "ballistic + spin": candidates.BY_NAME["ballistic + spin"],
    "bounces": candidates.BY_NAME["bounces"],
    "impact": breaks.BreakCandidate("impact", "ballistic_spin", ("v", "w", "dv", "dw", "c"), low=-0.3, high=-0.2),
    "slip": slips.Slip("spin, slipped", "ballistic_spin", ("w", "b"), start=5, stop=7, low=-0.3),
}


@pytest.mark.parametrize("name", LAWS)
def test_the_variance_is_that_of_paths_with_sampled_parameters(name):
    rng, law, factor = np.random.default_rng(0), LAWS[name], 4.0
    size = law.parameters
    theta, root = 0.5 * rng.normal(size=size), 0.003 * rng.normal(size=(size, size))
    place, turn = band._variance(solved(law, theta, np.linalg.inv(root @ root.T)), factor, AHEAD)
    sampled = theta + math.sqrt(factor) * rng.normal(size=(4000, size)) @ root.T
    quats, d = law.law.poses(law.law_parameters(sampled), AHEAD)
    true_quats, true = law.law.path(law.law_parameters(theta), AHEAD)
    angles = rotations.angle_between(quats, true_quats)
    np.testing.assert_allclose(place, ((d - true) ** 2).sum(-1).mean(0), rtol=0.1)
    np.testing.assert_allclose(turn, (angles**2).mean(0), rtol=0.1)


def test_the_variance_of_an_unknown_rotation_is_that_of_half_a_turn():
    law = candidates.BY_NAME["spin"]
    _, turn = band._variance(solved(law, np.zeros(law.parameters), 1e-6 * np.eye(law.parameters)), 1.0, AHEAD)
    np.testing.assert_allclose(turn, math.pi**2)


@pytest.mark.parametrize("gap", [0.0, 2.0, 10.0])
def test_another_candidate_spreads_the_band_by_its_squared_distance_and_evidence(gap):
    level = NoiseLevel(count=7, level=0.5, inflation=2.0)
    worse = np.zeros((7, 6))
    worse[0, 0] = math.sqrt(24 * np.expm1(gap / 24))  # Cauchy loss of `gap`
    chosen, other = moving((2, 1, 3), (0, 0, 0.5)), moving((3, -1, 3), (0, 0, 1.3), residuals=worse)
    assert level.score(other) - level.score(chosen) == pytest.approx(gap)
    place, turn = band._spread(chosen, [other, chosen], level, AHEAD)
    share = math.exp(-gap / 3.5) / (1 + math.exp(-gap / 3.5))
    np.testing.assert_allclose(place, share * 5 * AHEAD**2, atol=1e-12)
    np.testing.assert_allclose(turn, share * (0.8 * AHEAD) ** 2, atol=1e-12)


def falling(count):
    """Fall from the state of `moving` with v = (2, 0, 0), by an acceleration of 1 along each axis."""
    law = candidates.BY_NAME["ballistic + spin"]
    parts = {name: np.zeros(3) for name in ("r", "e", *law.blocks)} | {"v": np.array([2.0, 0, 0]), "a": np.ones(3)}
    return solved(law, law.pack(parts), residuals=np.zeros((count, 6)))


FALL = 3 * (0.5 * AHEAD**2) ** 2  # its squared distance from straight motion


def akaike(parameters, numbers):
    return 2 * parameters + 2 * parameters * (parameters + 1) / (numbers - parameters - 1)


@pytest.mark.parametrize("count", [7, 30])
def test_parameters_cost_the_band_what_akaike_s_criterion_for_few_data_says(count):
    chosen = moving((2, 0, 0), residuals=np.zeros((count, 6)))
    place, _ = band._spread(chosen, [chosen, falling(count)], NoiseLevel(count, 1.0, 1.0), AHEAD)
    share = 1 / (1 + math.exp((akaike(15, 6 * count) - akaike(12, 6 * count)) / 3.5))
    np.testing.assert_allclose(place, share * FALL, atol=1e-12)


@pytest.mark.parametrize("miss", [100.0, 1e4])
def test_one_pose_excludes_a_candidate_no_more_than_an_outlier_does(miss):
    residuals = np.zeros((30, 6))
    residuals[-1, 0] = miss
    chosen, straight = falling(30), moving((2, 0, 0), residuals=residuals)
    place, _ = band._spread(chosen, [straight, chosen], NoiseLevel(30, 1.0, 1.0), AHEAD)
    share = 1 / (1 + math.exp((candidates.SOFTNESS + akaike(12, 180) - akaike(15, 180)) / 3.5))
    np.testing.assert_allclose(place, share * FALL, atol=1e-12)
    residuals[-2, 0] = miss
    place, _ = band._spread(chosen, [moving((2, 0, 0), residuals=residuals), chosen], NoiseLevel(30, 1.0, 1.0), AHEAD)
    np.testing.assert_array_equal(place, 0)


def test_a_candidate_with_an_event_costs_the_choice_of_a_pose():
    chosen = moving((2, 0, 0), residuals=np.zeros((30, 6)))
    broken = breaks.BreakCandidate("start", "ballistic_spin", ("v", "w", "c"), low=-0.3, high=-0.2)
    parts = {name: np.zeros(3) for name in ("r", "e", *broken.blocks)} | {"v": np.array([1.0, 0, 0]), "c": np.zeros(1)}
    other = solved(broken, broken.pack(parts), residuals=np.zeros((30, 6)))
    place, _ = band._spread(chosen, [chosen, other], NoiseLevel(30, 1.0, 1.0), AHEAD)
    share = 1 / (1 + math.exp((akaike(13, 180) + 2 * math.log(30) - akaike(12, 180)) / 3.5))
    np.testing.assert_allclose(place, share * AHEAD**2, atol=1e-12)


def test_a_candidate_without_evidence_does_not_spread_the_band():
    level, worse = NoiseLevel(7, 1.0, 1.0), np.full((7, 6), 3.0)
    chosen, other = moving(), moving(v=(1, 0, 0), residuals=worse)
    np.testing.assert_array_equal(band._spread(chosen, [chosen, other], level, AHEAD), 0)


def selected(noise=(0.0, 0.0), level=1.0, chosen=None):
    """Selection of a known motion, of too few poses for a backtest."""
    chosen = chosen or moving(v=(1, 0, 0))
    tau = np.linspace(-1, 0, 7)
    track = PoseTrack(tau, *chosen.candidate.path(chosen.theta, tau), np.ones(7))
    return search.Selected(chosen, (chosen,), NoiseLevel(7, level, 1.0), track, candidates.Noise(*noise), -1.0)


def relative(widths):
    """Squared half widths of the position and of the rotation, relative to those of unit variances."""
    return (np.array(widths.half_width) / 1.4) ** 2, (np.array(widths.half_angle) / 1.4) ** 2


@pytest.mark.parametrize("slipped", [False, True])
def test_the_noise_of_the_last_pose_fades_like_its_offset_in_the_prediction(slipped):
    chosen = moving(v=(1, 0, 0))
    if slipped:
        law = slips.Slip("translation, slipped", "translation", ("v", "b"), start=5, stop=7, low=-0.3)
        chosen = solved(law, np.r_[np.zeros(6), 1, 0, 0, 0.5, 0, 0])
    off = np.r_[0, 0, 0, 0.1, 0, 0, chosen.theta[6:]]
    moved = solved(chosen.candidate, off)
    offsets = []
    for solution in (chosen, moved):
        model = fitted_motion.to_model(solution, 1.0, 1.0, 1.0)
        offsets.append(models.evaluate(model, np.linspace(0, 1, band.MAX_KNOTS))[1])
    left = 1 - np.linalg.norm(offsets[1] - offsets[0], axis=-1) / 0.1  # share of the offset not yet left
    widths = band.confidence_band(selected((0.02, 0.03), 2.0, chosen), 1.0, candidates.Noise(0, 0))
    place, turn = relative(widths)
    np.testing.assert_allclose(turn, 2 * 3 * 0.03**2 * left**2, atol=1e-10)
    np.testing.assert_allclose(place, 2 * 3 * (0.02**2 + 2 / 3 * 0.03**2) * left**2, atol=1e-10)


def test_a_band_adds_the_variances_of_all_causes():
    law = candidates.BY_NAME["translation + spin"]
    parts = {"r": np.zeros(3), "e": np.zeros(3), "v": np.array([1.0, 0, 0]), "w": np.array([0, 0, 0.5])}
    root = 0.05 * np.random.default_rng(1).normal(size=(12, 12))
    chosen = solved(law, law.pack(parts), np.linalg.inv(root @ root.T))
    other = moving(v=(1.2, 0.1, 0), w=(0, 0, 0.6))
    one, drift = selected((0.02, 0.03), 1.0, chosen), candidates.Noise(0.04, 0.05)
    both = dataclasses.replace(one, solutions=(chosen, other))
    widths = band.confidence_band(both, 2.0, drift)
    own = np.array(band._variance(chosen, 2.0, widths.tau))
    spread = np.array(band._spread(chosen, [chosen, other], one.noise_level, widths.tau))
    exact = moving(v=(1, 0, 0), w=(0, 0, 0.5))
    rest = np.array(relative(band.confidence_band(selected((0.02, 0.03), 1.0, exact), 2.0, drift)))
    place, turn = relative(widths)
    np.testing.assert_allclose(turn, own[1] + spread[1] + rest[1], atol=1e-9)
    np.testing.assert_allclose(place, own[0] + spread[0] + 2 / 3 * (own[1] + spread[1]) + rest[0], atol=1e-9)


def test_a_drift_at_a_constant_rate_grows_from_the_middle_of_the_window():
    drift = band.drift_noise(candidates.Noise(0.001, 0.1), candidates.Noise(0.02, 0.01))
    rate = np.array([math.sqrt(12) * 0.02, 5 * 0.1])  # over the span
    np.testing.assert_allclose((drift.place, drift.turn), rate)
    uniform = np.linspace(-0.5, 0.5, 100001) * rate[0]
    assert uniform.std() == pytest.approx(0.02, rel=1e-4)
    widths = band.confidence_band(selected(), 1.0, drift)
    away = 0.5 + widths.tau
    place, turn = relative(widths)
    np.testing.assert_allclose(turn, 3 * (rate[1] * away) ** 2, atol=1e-10)
    np.testing.assert_allclose(place, 3 * (rate[0] ** 2 + 2 / 3 * rate[1] ** 2) * away**2, atol=1e-10)


def test_a_prediction_is_trusted_until_its_half_width_is_a_fifth_of_the_size():
    times, radius = (2.0, 2.5, 3.0), 0.2
    found = band.trusted(Band(times, (0.02, 0.12, 0.18), (0.0, 0.0, 0.0)), radius)
    assert np.interp(found.predictable_until, times, found.half_width) == pytest.approx(2 * radius / 5)
    assert band.trusted(Band(times, (0.02, 0.07, 0.075), (0.0, 0.0, 0.0)), radius).predictable_until is None
    assert band.trusted(Band(times, (0.15, 0.16, 0.18), (0.0, 0.0, 0.0)), radius).predictable_until == 2.0


def test_a_band_scales_with_the_radius_and_the_span():
    tau = np.array([0.0, 0.5, 1.0])
    widths = band.Widths(tau, np.array([0.1, 0.2, 0.9]), np.array([0.1, 1.0, 4.0]), 0.75)
    scaled = widths.scaled(t_max=2.0, radius=0.3, span=4.0)
    np.testing.assert_allclose(scaled.times, [2, 4, 6])
    np.testing.assert_allclose(scaled.half_width, [0.03, 0.06, 0.27])
    np.testing.assert_allclose(scaled.half_angle, [0.1, 1.0, math.pi])
    assert scaled.predictable_until == 5.0
    assert dataclasses.replace(widths, trusted=None).scaled(2.0, 0.3, 4.0).predictable_until is None

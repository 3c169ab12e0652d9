import math

import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion_fit import breaks, candidates, fitted_motion

RADIUS, SPAN, T_MAX = 0.3, 2.0, 5.0
COUNT = 15


def solved(law, theta, root):
    """Solution of given parameters whose covariance is root root^T."""
    normal = np.linalg.inv(root @ root.T)
    return candidates.FittedCandidate(law, theta, normal, np.zeros((COUNT, 6)), np.ones(COUNT))


def drawn(name, seed=0):
    rng, law = np.random.default_rng(seed), candidates.BY_NAME[name]
    size = law.parameters
    return solved(law, 0.5 * rng.normal(size=size), 0.01 * rng.normal(size=(size, size)))


def test_the_covariance_of_linear_rates_scales_with_the_radius_and_the_span():
    solution = drawn("translation, quadratic")
    model = fitted_motion.to_model(solution, 3.0, RADIUS, SPAN)
    labels = [f"{rate}.{axis}" for rate in ("velocity", "acceleration") for axis in "xyz"]
    rows = [model.covariance_names.index(label) for label in labels]
    own = np.r_[solution.candidate.rows["v"], solution.candidate.rows["a"]]
    units = np.repeat([RADIUS / SPAN, RADIUS / SPAN**2], 3)
    covariance = np.linalg.inv(solution.normal)[np.ix_(own, own)]
    expected = 3.0 * np.outer(units, units) * covariance
    np.testing.assert_allclose(model.covariance[np.ix_(rows, rows)], expected, rtol=1e-4)


@pytest.mark.parametrize("name", ["ballistic + spin", "pendulum", "drag"])
def test_the_covariance_of_the_model_is_that_of_sampled_parameters(name):
    rng, solution, factor = np.random.default_rng(1), drawn(name), 0.25
    model = fitted_motion.to_model(solution, factor, RADIUS, SPAN)
    np.testing.assert_array_equal(model.covariance, model.covariance.T)
    root = np.linalg.cholesky(np.linalg.inv(solution.normal))
    sampled = solution.theta + math.sqrt(factor) * rng.normal(size=(4000, len(root))) @ root.T
    fields = fitted_motion._fields(solution.candidate, sampled, RADIUS, SPAN)
    names = list(dict.fromkeys(label.split(".")[0] for label in model.covariance_names))
    values = np.concatenate([fields[field] for field in names], -1)
    deviations = values.std(0)
    free = deviations > 0
    np.testing.assert_array_equal(model.covariance[~free], 0)
    scale = np.outer(deviations, deviations)[np.ix_(free, free)]
    found, expected = model.covariance[np.ix_(free, free)], np.cov(values.T)[np.ix_(free, free)]
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.1)


@pytest.mark.parametrize("name", ["ballistic + spin", "pendulum", "damped spring", "drag", "precession"])
def test_the_model_moves_like_the_law_in_world_units(name):
    solution = drawn(name, seed=2)
    model = fitted_motion.to_model(solution, 1.0, RADIUS, SPAN)
    tau = np.linspace(0, 0.5, 4)
    quats, d = models.evaluate(model, SPAN * tau)
    law_quats, law_d = solution.candidate.path(solution.theta, tau)
    # The model starts from the observed pose and approaches the fitted curve.
    left = np.exp(-tau / fitted_motion.fade_time(solution))[:, None]
    parts = solution.candidate.parts(solution.theta)
    np.testing.assert_allclose(d / RADIUS, law_d - left * parts["e"], atol=1e-6)
    rests = rotations.rotvecs_to_quats(np.stack([parts["r"]] * len(tau)))
    turned = rotations.multiply(law_quats, rotations.conjugate(rests))
    expected = rotations.multiply(turned, rotations.rotvecs_to_quats((1 - left) * parts["r"]))
    assert np.max(rotations.angle_between(quats, expected)) < 1e-6


@pytest.mark.parametrize("logit", [-1.0, 0.5])
def test_the_time_of_a_break_has_the_error_of_its_parameter(logit):
    low, high, factor = -0.4, -0.3, 2.0
    law = breaks.BreakCandidate("impact", "ballistic_spin", ("v", "w", "dv", "dw", "c"), low=low, high=high)
    rng, size = np.random.default_rng(3), law.parameters
    theta = rng.normal(size=size)
    theta[-1] = logit
    solution = solved(law, theta, 0.1 * rng.normal(size=(size, size)))
    (event,) = fitted_motion.events(solution, factor, T_MAX, SPAN)
    share = 1 / (1 + math.exp(-logit))
    assert event.kind == "impact"
    assert event.time == pytest.approx(T_MAX + SPAN * (low + (high - low) * share))
    sigma = math.sqrt(factor * np.linalg.inv(solution.normal)[-1, -1])
    assert event.sigma == pytest.approx(SPAN * (high - low) * share * (1 - share) * sigma, rel=1e-4)


@pytest.mark.parametrize("name", ["impact in flight", "land", "throw"])
def test_segments_hold_the_rates_at_their_ends(name):
    broken = breaks.BREAKS[name]
    law = breaks.BreakCandidate(name, "ballistic_spin", (*broken.blocks, "c"), low=-0.4, high=-0.3)
    rng, size = np.random.default_rng(4), law.parameters
    theta = rng.normal(size=size)
    theta[3:-1] *= 2
    solution = solved(law, theta, 0.1 * rng.normal(size=(size, size)))
    found = fitted_motion.events(solution, 1.0, T_MAX, SPAN)
    segments = fitted_motion.segments([solution] * 2, found, T_MAX - SPAN, T_MAX, RADIUS, SPAN)
    assert [(x.start, x.stop) for x in segments] == [(T_MAX - SPAN, found[0].time), (found[0].time, T_MAX)]
    for segment in segments:
        # Parabolas through poses shortly before the end, and the turn between them about the constant axis.
        tau = (segment.stop - T_MAX) / SPAN - np.array([0.02, 0.01, 1e-9])
        quats, d = law.path(theta, tau)
        fit = np.polynomial.Polynomial
        curves = [fit.fit(SPAN * tau, RADIUS * d[:, axis], 2) for axis in range(3)]
        velocity, acceleration = ([curve.deriv(k)(SPAN * tau[-1]) for curve in curves] for k in (1, 2))
        turn = rotations.quats_to_rotvecs(rotations.multiply(quats[1], rotations.conjugate(quats[0])))
        expected = {"velocity": velocity, "acceleration": acceleration, "angular_velocity": turn / (0.01 * SPAN)}
        if segment.kind == "static":
            assert max(np.abs(value).max() for value in expected.values()) < 1e-6
        for rate, value in expected.items():
            np.testing.assert_allclose(segment.parameters[rate], value, atol=0.01, err_msg=rate)
    rests = [segment.kind == "static" for segment in segments]
    assert rests == [broken.rests_before, broken.rests_after]

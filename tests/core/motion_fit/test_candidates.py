import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import breaks, candidates, slips

NOISE = candidates.Noise(0.01, 0.02)
TAU = np.linspace(-1, 0, 9)


def random_track(rng):
    quats = rotations.rotvecs_to_quats(0.5 * rng.normal(size=(len(TAU), 3)))
    return PoseTrack(TAU, quats, rng.normal(size=(len(TAU), 3)), np.ones(len(TAU)))


@pytest.mark.parametrize("name", ["ballistic + spin", "pendulum", "drag", "precession", "bounces"])
def test_derivatives_of_the_residuals_match_central_differences(name):
    rng = np.random.default_rng(0)
    law, track, step = candidates.BY_NAME[name], random_track(rng), 1e-4
    theta = 0.3 * rng.normal(size=law.parameters)
    values, slopes = candidates.linearized(law, theta, track, NOISE)
    np.testing.assert_array_equal(values, candidates.residuals(law, theta, track, NOISE))
    nudges = step * np.eye(len(theta))
    up, down = (candidates.residuals(law, theta + sign * nudges, track, NOISE) for sign in (1, -1))
    np.testing.assert_allclose(slopes, (up - down) / (2 * step), atol=1e-4 * np.abs(slopes).max())


def test_a_linear_law_is_fitted_by_weighted_least_squares():
    rng = np.random.default_rng(1)
    law, sigma = candidates.BY_NAME["translation, quadratic"], 1e-3
    weights = rng.uniform(0.5, 1.5, len(TAU))
    d = rng.normal(size=3) + TAU[:, None] * rng.normal(size=3) + sigma * rng.normal(size=(len(TAU), 3))
    track = PoseTrack(TAU, rotations.identity(len(TAU)), d, weights)
    noise = candidates.Noise(100 * sigma, 1.0)  # so that all residuals are small, and robust weights near one
    solution = candidates.solve(law, track, noise, steps=40, enough=1e-20)
    assert solution is not None
    columns = np.stack([np.ones_like(TAU), TAU, 0.5 * TAU**2], -1)
    root = np.sqrt(weights)[:, None]
    expected = np.linalg.lstsq(root * columns, root * d, rcond=None)[0]
    parts = law.parts(solution.theta)
    np.testing.assert_allclose([parts[name] for name in ("e", "v", "a")], expected, atol=0.01 * sigma)
    covariance = noise.place**2 * np.linalg.inv((root * columns).T @ (root * columns))
    rows = [law.rows[name][0] for name in ("e", "v", "a")]
    np.testing.assert_allclose(solution.inverse[np.ix_(rows, rows)], covariance, rtol=0.01)


@pytest.mark.parametrize("name", [*breaks.BREAKS, "slip"])
def test_the_slopes_of_the_last_law_match_central_differences(name):
    rng = np.random.default_rng(2)
    if name == "slip":
        broken = slips.Slip("spin, slipped", "ballistic_spin", ("w", "b"), start=5, stop=9, low=-0.5)
    else:
        broken = breaks.BreakCandidate(name, "ballistic_spin", (*breaks.BREAKS[name].blocks, "c"), low=-0.6, high=-0.5)
    theta, step = rng.normal(size=broken.parameters), 1e-4
    solution = candidates.FittedCandidate(broken, theta, np.eye(len(theta)), np.zeros((9, 6)), np.ones(9))
    for column, nudge in zip(solution.law_slopes.T, step * np.eye(len(theta)), strict=True):
        slope = (broken.law_parameters(theta + nudge) - broken.law_parameters(theta - nudge)) / (2 * step)
        np.testing.assert_allclose(column, slope, atol=1e-5)


@pytest.mark.parametrize("name", breaks.BREAKS)
def test_after_the_break_the_last_law_goes_on(name):
    rng = np.random.default_rng(3)
    broken = breaks.BreakCandidate(name, "ballistic_spin", (*breaks.BREAKS[name].blocks, "c"), low=-0.6, high=-0.5)
    theta, later = rng.normal(size=broken.parameters), np.linspace(-0.5, 0, 6)
    quats, d = broken.path(theta, later)
    law_quats, law_d = broken.law.path(broken.law_parameters(theta), later)
    np.testing.assert_allclose(law_d - law_d[-1], d - d[-1], atol=1e-12)
    turns = (rotations.multiply(x, rotations.conjugate(x[-1])) for x in (quats, law_quats))
    assert np.max(rotations.angle_between(*turns)) < 1e-7

"""Curves through knots keep jumps of their slopes at known times."""

import numpy as np
import pytest

from r5dgs_core.motion import cubic_curves, impacts

TIMES = np.linspace(0.0, 1.1, 12)


def bounce(t, hit=0.47):
    """A body that falls, is reflected with three quarters of its speed, and flies on; and its slopes. [T, 3]"""
    t = np.asarray(t, np.float64)[..., None]
    tau, down = t - hit, np.array([0.4, 0.0, -2.0])
    up, g = np.array([0.3, 0.1, 1.5]), np.array([0.0, 0, -3.0])
    place = np.where(tau < 0, down * tau, up * tau) + 0.5 * g * tau**2
    return place, np.where(tau < 0, down, up) + g * tau


def test_a_parabola_before_and_after_an_impact_is_exact():
    keys = impacts.keys(TIMES, bounce(TIMES)[0], [0.47])
    at = np.linspace(0, 1.1, 331)
    np.testing.assert_allclose(cubic_curves.evaluate(keys, at), bounce(at)[0], atol=1e-12)
    (k,) = np.flatnonzero(keys.times == 0.47)
    np.testing.assert_allclose(keys.left_slopes[k], [0.4, 0, -2], atol=1e-10)
    np.testing.assert_allclose(keys.right_slopes[k], [0.3, 0.1, 1.5], atol=1e-10)
    smooth = impacts.keys(TIMES, bounce(TIMES)[0], [])
    assert np.abs(cubic_curves.evaluate(smooth, at) - bounce(at)[0]).max() > 0.03


def test_without_jumps_the_curve_is_that_of_the_knots():
    values = np.random.default_rng(0).normal(size=(12, 4))
    keys = impacts.keys(TIMES, values, [])
    np.testing.assert_array_equal(keys.left_slopes, cubic_curves.slopes(TIMES, values))
    np.testing.assert_array_equal(keys.left_slopes, keys.right_slopes)


@pytest.mark.parametrize("beside", [-1e-4, 0.0, 1e-4])
def test_an_impact_at_a_knot_gives_it_two_slopes(beside):
    keys = impacts.keys(TIMES, bounce(TIMES, TIMES[5])[0], [TIMES[5] + beside])
    np.testing.assert_array_equal(keys.times, TIMES)
    np.testing.assert_allclose(keys.left_slopes[5], [0.4, 0, -2], atol=1e-10)
    np.testing.assert_allclose(keys.right_slopes[5], [0.3, 0.1, 1.5], atol=1e-10)


def test_two_impacts_are_kept():
    later = np.where(TIMES[:, None] < 0.83, bounce(TIMES)[0], bounce([0.83])[0] - 0.7 * (TIMES[:, None] - 0.83))
    keys = impacts.keys(TIMES, later, [0.83, 0.47])
    assert {0.47, 0.83} <= set(keys.times) and len(keys.times) == 14
    np.testing.assert_allclose(cubic_curves.evaluate(keys, np.array(0.83)), bounce(0.83)[0], atol=1e-10)


@pytest.mark.parametrize("jump", [-1.0, 0.0, 0.05, 1.05, 1.1, 3.0])
def test_a_side_with_one_knot_stays_smooth(jump):
    values = bounce(TIMES)[0]
    np.testing.assert_array_equal(impacts.keys(TIMES, values, [jump]).left_slopes, cubic_curves.slopes(TIMES, values))


def test_a_wrong_time_leaves_the_curve_smooth():
    values = bounce(TIMES)[0]
    np.testing.assert_array_equal(impacts.keys(TIMES, values, [0.66]).times, TIMES)


def test_noise_around_an_impact_is_not_amplified():
    draws = np.random.default_rng(1)
    at = np.linspace(0.3, 0.6, 61)
    worst = {"sharp": [], "smooth": []}
    for _ in range(40):
        values = bounce(TIMES)[0] + draws.normal(scale=0.002, size=(12, 3))
        for name, jumps in (("sharp", [0.47 + draws.normal(scale=0.004)]), ("smooth", [])):
            worst[name].append(
                np.abs(cubic_curves.evaluate(impacts.keys(TIMES, values, jumps), at) - bounce(at)[0]).max()
            )
    assert np.median(worst["sharp"]) < 0.5 * np.median(worst["smooth"])


def test_one_knot_is_a_rest():
    found = impacts.keys(np.zeros(1), np.ones((1, 3)), [0.5])
    assert found.values.tolist() == [[1, 1, 1]] and not found.left_slopes.any()

"""One gravity for all that falls."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from r5dgs_core.motion.models import MotionModel
from r5dgs_core.motion_fit import model_selection, shared_gravity
from tests.support import problems
from tests.support.problems import RADIUS, SIZE, T_MAX

pytestmark = pytest.mark.heavy

TIMES = np.linspace(0, T_MAX, 15)
G = np.array([0.0, 0.0, -9.0])


def body(velocity, acceleration, spin=(0, 0, 0)):
    kind = "ballistic_spin" if any(spin) else "translation"
    return MotionModel(kind, velocity=velocity, acceleration=acceleration, angular_velocity=spin)


FALLING = [body([1, 0, -2], G), body([-0.5, 1, 1], G, (1, 2, 0.5)), body([0, 0.4, -4], G)]
SPEEDING = body([1.5, 0, 0], [3.0, 0.5, 0])
SLIDING = body([0.5, 0.2, 0], [0, 0, 0])


def observed(truths, rng, sigma=0.005 * SIZE):
    tracks, fits, lasts = [], [], []
    for truth in truths:
        quats, d, last_quat, last = problems.observe(truth, TIMES, rng, sigma, 2 * sigma)
        tracks.append(shared_gravity.BodyTrack(TIMES, quats, d, np.ones(len(TIMES))))
        fits.append(model_selection.fit(TIMES, quats, d, radius=RADIUS))
        lasts.append((last_quat, last))
    return tracks, fits, lasts


@pytest.fixture(scope="module")
def falls():
    rng = np.random.default_rng(0)
    return [observed(FALLING, rng) for _ in range(4)]


@pytest.mark.slow
@pytest.mark.parametrize("up", [None, np.array([0, 0, 2.0])])
def test_bodies_that_fall_share_gravity_and_are_predicted_better(falls, up):
    alone, together, sharing = [], [], []
    for tracks, fits, lasts in falls:
        shared, who = shared_gravity.share_acceleration(tracks, fits, up)
        assert {0, 2} <= set(who)
        sharing += who
        for i in who:
            truth, before, after, last = FALLING[i], fits[i], shared[i], lasts[i]
            alone.append(problems.error_percent(before.model, truth, np.array([1.25]), *last)[0])
            together.append(problems.error_percent(after.model, truth, np.array([1.25]), *last)[0])
            np.testing.assert_array_equal(after.model.acceleration, shared[0].model.acceleration)
            assert after.chosen == before.chosen
            widths = (np.array(fit.history.band.half_width) for fit in (after, before))
            assert (next(widths) <= next(widths) * 1.5).all()
            if up is not None:
                np.testing.assert_allclose(after.model.acceleration[:2], 0, atol=1e-12)
    assert 1 in sharing  # where noise gave it no other motion
    assert np.median(together) < 0.75 * np.median(alone)


@pytest.mark.slow
def test_bodies_with_deviating_acceleration_do_not_share_gravity():
    tracks, fits, _ = observed([*FALLING[:2], SPEEDING, SLIDING], np.random.default_rng(1), 0.002 * SIZE)
    assert fits[2].chosen == "translation, quadratic"
    shared, who = shared_gravity.share_acceleration(tracks, fits)
    assert who == (0, 1)
    assert shared[2] is fits[2]
    assert shared[3] is fits[3]
    assert np.linalg.norm(shared[0].model.acceleration - G) < 0.3


def test_gravity_needs_at_least_two_agreeing_bodies():
    tracks, fits, _ = observed([FALLING[0], SPEEDING], np.random.default_rng(2), 0.002 * SIZE)
    for count in (0, 1, 2):
        shared, who = shared_gravity.share_acceleration(tracks[:count], fits[:count])
        assert who == ()
        assert all(x is y for x, y in zip(shared, fits, strict=False))


def test_bodies_with_equal_acceleration_share_it_only_if_they_fall():
    tracks, fits, _ = observed([SPEEDING, SPEEDING], np.random.default_rng(3), 0.002 * SIZE)
    assert shared_gravity.share_acceleration(tracks, fits)[1] == (0, 1)
    assert shared_gravity.share_acceleration(tracks, fits, np.array([0, 0, 1.0]))[1] == ()


def test_bodies_that_came_to_rest_do_not_share():
    tracks, fits, _ = observed(FALLING, np.random.default_rng(4))
    fits[0] = dataclasses.replace(fits[0], rested=True)
    assert shared_gravity.share_acceleration(tracks, fits)[1] == (1, 2)


def test_without_noise_gravity_is_exact():
    tracks, fits, lasts = observed(FALLING, np.random.default_rng(5), 1e-9)
    shared, who = shared_gravity.share_acceleration(tracks, fits)
    assert who == (0, 1, 2)
    for truth, fit, last in zip(FALLING, shared, lasts, strict=True):
        assert problems.error_percent(fit.model, truth, np.array([1.25]), *last)[0] < 0.01


def test_a_direction_that_is_none_is_refused():
    for up in (np.zeros(3), np.array([1.0, np.nan, 0]), np.ones(2)):
        with pytest.raises(ValueError, match="up"):
            shared_gravity.share_acceleration([], [], up)


def pulled(*along_x):
    """Accelerations along x with unit covariance."""
    return {i: (np.array([x, 0.0, 0.0]), np.eye(3)) for i, x in enumerate(along_x)}


@pytest.mark.parametrize(
    ("accelerations", "expected"),
    [
        ((0, 3, 20, 21), [2, 3]),  # of two pairs, the tighter one
        ((20, 21, 0, 3), [0, 1]),
        ((0, 1, 20, 24, 22), [2, 3, 4]),  # of two sets, the larger one
        ((0, 4, 8), [0, 1]),  # all neighbours agree, but not in pairs
        ((0, 10, 20), [0]),
        ((), []),
    ],
)
def test_the_largest_and_tightest_set_of_agreeing_bodies_shares(accelerations, expected):
    assert shared_gravity._largest_agreeing(pulled(*accelerations)) == expected


def test_bodies_agree_within_the_99_percent_quantile_of_their_difference():
    limit = np.sqrt(2 * chi2.ppf(0.99, 3))
    assert len(shared_gravity._largest_agreeing(pulled(0, 0.999 * limit))) == 2
    assert len(shared_gravity._largest_agreeing(pulled(0, 1.001 * limit))) == 1


@pytest.mark.parametrize("basis", [np.eye(3), np.array([[0.6], [0.0], [0.8]])], ids=["all directions", "vertical"])
def test_the_mean_acceleration_is_that_of_generalized_least_squares(basis):
    rng = np.random.default_rng(6)
    roots, accelerations = rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3))
    found = [(a, root @ root.T) for a, root in zip(accelerations, roots, strict=True)]
    mean, covariance = shared_gravity._mean(found, basis)
    whitened = np.concatenate([np.linalg.solve(root, basis) for root in roots])
    values = np.concatenate([np.linalg.solve(root, a) for root, a in zip(roots, accelerations, strict=True)])
    np.testing.assert_allclose(mean, basis @ np.linalg.lstsq(whitened, values, rcond=None)[0], atol=1e-10)
    inverse = np.linalg.pinv(whitened)
    np.testing.assert_allclose(covariance, basis @ inverse @ inverse.T @ basis.T, atol=1e-10)


def test_each_pair_of_bodies_is_compared_once_in_each_direction(monkeypatch):
    rng = np.random.default_rng(0)
    found = {i: (0.3 * rng.normal(size=3), np.eye(3)) for i in range(40)}
    solved, solve = [], np.linalg.solve

    def counted(matrices, values):
        solved.append(np.prod(np.shape(matrices)[:-2], dtype=int))
        return solve(matrices, values)

    monkeypatch.setattr(np.linalg, "solve", counted)
    assert shared_gravity._largest_agreeing(found) == list(range(40))
    assert sum(solved) == 40**2


@pytest.mark.parametrize("seed", range(10))
def test_the_agreeing_set_is_grown_from_the_nearest_body_of_each(seed):
    rng = np.random.default_rng(seed)
    found = {i: (2 * rng.normal(size=3), np.diag(rng.uniform(0.2, 1, 3))) for i in rng.permutation(20)[:12].tolist()}

    def agree(i, j):
        return shared_gravity._apart(*found[i], *found[j]) < shared_gravity.AGREE

    sets = []
    for first in found:
        distances = {i: shared_gravity._apart(*found[first], *found[i]) for i in found if i != first}
        chosen = [first]
        for i in sorted(distances, key=distances.__getitem__):
            chosen += [i] if all(agree(i, j) for j in chosen) else []
        sets.append((len(chosen), -sum(distances[i] for i in chosen[1:]), sorted(chosen)))
    assert shared_gravity._largest_agreeing(found) == max(sets, key=lambda entry: entry[:2])[2]
    assert 1 < max(sets)[0] < 12

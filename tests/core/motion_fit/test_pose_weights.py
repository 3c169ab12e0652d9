"""Weights, noise and drift of tracks whose poses have known errors."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion.history import PoseErrors
from r5dgs_core.motion_fit import pose_weights


def test_poses_with_large_errors_count_less_and_unseen_ones_not_at_all():
    errors = PoseErrors((0.1, 0.1, 0.1, 0.3, np.inf, 0.1), (0.1, 0.1, 0.1, 0.3, np.inf, 0.1))
    observed = np.array([True, True, True, True, True, False])
    found = pose_weights.from_errors(errors, observed, 1.0, True)
    assert found.weights[:3].tolist() == [1, 1, 1] and found.weights[3] == pytest.approx(0.2)
    assert found.weights[4:].tolist() == [0, 0]
    assert found.drift == (0.1, 0.1) and found.noise == pytest.approx((0.075, 0.075))


def test_errors_of_rotations_count_only_if_rotations_are_used():
    errors = PoseErrors((0.1,) * 4, (9.0, 0.1, 0.1, 0.1))
    with_turns, without = (pose_weights.from_errors(errors, np.ones(4, bool), 1.0, turns) for turns in (True, False))
    assert without.weights[0] == 1 > with_turns.weights[0]
    assert without.drift == (0.1, 0) and with_turns.drift == (0.1, 0.1)


def test_without_any_view_all_observed_poses_count_alike():
    errors, observed = PoseErrors((np.inf,) * 2, (np.inf,) * 2), np.array([True, False])
    for found in (pose_weights.from_errors(given, observed, 1.0, True) for given in (errors, None)):
        assert found.weights.tolist() == [1, 0] and found.noise == found.drift == (0, 0)
    exact = dataclasses.replace(errors, place=(0.0,) * 2, turn=(0.0,) * 2)
    assert pose_weights.from_errors(exact, np.array([True, True]), 1.0, True).weights.tolist() == [1, 1]


def test_a_body_that_bends_drifts_by_its_bends_and_its_noise_stays():
    errors, observed = PoseErrors((0.1,) * 4, (0.2,) * 4), np.ones(4, bool)
    rigid, bent = (pose_weights.from_errors(errors, observed, 2.0, True, bend) for bend in (0.0, 3.0))
    assert bent.drift == pytest.approx((np.hypot(0.1, 3**0.5), np.hypot(0.2, 3**0.5 / 2)))
    assert bent.noise == rigid.noise and bent.weights.tolist() == rigid.weights.tolist()
    assert pose_weights.from_errors(None, observed, 2.0, True, 3.0).drift == pytest.approx((3**0.5, 3**0.5 / 2))


def test_unknown_errors_of_places_do_not_make_the_noise_of_rotations_infinite_or_the_reverse():
    some, all_true = (0.1, np.inf, np.inf), np.ones(3, bool)
    for place, turn in ((some, (0.2,) * 3), ((0.2,) * 3, some)):
        found = pose_weights.from_errors(PoseErrors(place, turn), all_true, 1.0, True)
        assert found.drift == (np.median(place[:1]), np.median(turn[:1])) and np.isfinite(found.noise).all()

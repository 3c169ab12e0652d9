"""Samples of the motion of a body."""

import statistics

import numpy as np
import pytest

from r5dgs_core.contact import futures, identify
from r5dgs_core.motion import rotations

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(("predicted", "share"), [(0.0, 0.25), (0.5, 0.25), (np.pi / 2, 0.75)])
def test_other_faces_are_those_that_a_prediction_does_not_show(predicted, share):
    about_x = rotations.rotvecs_to_quats(np.array([[angle, 0.0, 0.0] for angle in (0.0, 0.1, -0.1, np.pi / 2)]))
    found = futures.Futures(np.zeros(1), about_x[None], np.zeros((1, 4, 3)))
    shown = rotations.rotvecs_to_quats(np.array([predicted, 0.0, 0.0]))
    assert found.other_faces(shown, UP) == share
    assert found.other_faces(-shown, UP) == share


@pytest.mark.parametrize("first", [(0.0, 0.0, 0.0), (0.0, np.pi / 2, 0.0)])
@pytest.mark.parametrize(("turn", "other"), [((0, 0, 1.0), False), ((0, 0, 3.0), False), ((0, np.pi / 2, 0), True)])
def test_a_yaw_is_no_other_face_and_a_tip_is(first, turn, other):
    shown = rotations.rotvecs_to_quats(np.array(first))
    turned = rotations.multiply(rotations.rotvecs_to_quats(np.array(turn)), shown)
    assert futures.on_other_face(turned, shown, UP) == other
    assert futures.on_other_face(shown, turned, UP) == other


def test_each_parameter_is_drawn_once_from_each_of_equally_likely_intervals():
    drawn = futures.normals(50, np.random.default_rng(0))
    limits = [statistics.NormalDist().inv_cdf(k / 50) for k in range(1, 50)]
    for column in drawn.T:
        np.testing.assert_array_equal(np.bincount(np.searchsorted(limits, column)), np.ones(50))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(identify.PARAMETERS)).max() < 0.6

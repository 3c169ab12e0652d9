"""Marker of observed and predicted time."""

import numpy as np

from r5dgs_core.film import time_marker

SPAN, T_MAX = (0.0, 1.0), 0.75


def test_the_bar_divides_past_and_future_and_shows_the_present():
    gray = np.full((120, 200, 3), 0.5, np.float32)
    found = time_marker.draw(gray, 0.5, T_MAX, SPAN)
    row = found[-1]
    np.testing.assert_allclose(row[20], time_marker.PAST, atol=1e-6)
    np.testing.assert_allclose(row[120], np.multiply(time_marker.DIMMED, time_marker.PAST), atol=1e-6)
    np.testing.assert_allclose(row[180], np.multiply(time_marker.DIMMED, time_marker.FUTURE), atol=1e-6)
    np.testing.assert_allclose(row[100], time_marker.CURSOR)
    assert (found[:90] == 0.5).all() and (gray == 0.5).all()


def test_the_word_names_observed_and_predicted_time():
    gray = np.full((120, 200, 4), 0.5, np.float32)
    words = [time_marker.draw(gray, t, T_MAX, SPAN)[:-4] for t in (0.2, 0.7, T_MAX, 0.8, 1.0)]
    assert [(word == words[0]).all() for word in words] == [True, True, True, False, False]
    assert (words[4] == words[3]).all()
    reddish = (words[3][..., 0] > words[3][..., 2] + 0.2).sum()
    bluish = (words[0][..., 2] > words[0][..., 0] + 0.2).sum()
    assert reddish > 50 and bluish > 50


def test_small_and_clipped_pictures_are_marked_too():
    for shape in ((2, 3, 3), (16, 16, 4)):
        found = time_marker.draw(np.zeros(shape, np.float32), 2.0, T_MAX, SPAN)
        assert found.shape == shape and np.isfinite(found).all()


def test_a_scene_of_one_time_has_a_bar_that_has_been_played():
    row = time_marker.draw(np.zeros((60, 80, 3), np.float32), 1.0, 1.0, (1.0, 1.0))[-1]
    np.testing.assert_allclose(row[-1], time_marker.CURSOR)
    np.testing.assert_allclose(row[:-2], np.broadcast_to(time_marker.PAST, (78, 3)), atol=1e-6)

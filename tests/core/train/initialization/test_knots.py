"""Knots of the tracks, of cameras that record together, at different moments, in turns, or while they move."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.train import train_views
from r5dgs_core.train.initialization import knots
from tests.support import scenes

STEPS = 0.1 * np.arange(10)


def recorded(*cameras):
    """Views of cameras, each with its name and times; the poses of moving cameras are called NAME, NAME@1, ..."""
    places = [scenes.orbit_camera(2 * np.pi * k / len(cameras)) for k in range(len(cameras))]
    image = np.zeros((4, 4, 3), np.uint8)
    return [
        train_views.of_arrays("v", dataclasses.replace(camera, name=name), float(t), image)
        for (name, times), camera in zip(cameras, places, strict=True)
        for t in times
    ]


def test_knots_are_the_observed_times():
    times = [0.0, 0.1, 0.5, 0.7]
    assert knots.of(recorded(*((name, times) for name in "abcd"))).tolist() == times
    assert knots.of(recorded(("a", [0.3]))).tolist() == [0.3]
    alone = [0.0, 0.01, 0.011, 0.5]  # each camera has one time
    assert knots.of(recorded(*((name, [t]) for name, t in zip("abcd", alone, strict=True)))).tolist() == alone


def test_cameras_with_slightly_different_times_share_their_knots():
    seen = recorded(*((name, STEPS + shift) for name, shift in zip("abcd", (0.0, 0.001, -0.002, 0.003), strict=True)))
    found = knots.of(seen)
    np.testing.assert_allclose(found[1:-1], STEPS[1:-1] + 0.0005, atol=1e-9)
    assert (found[0], found[-1]) == (min(view.t for view in seen), max(view.t for view in seen))


def test_cameras_share_their_knots_if_they_differ_by_less_than_half_a_step():
    found = knots.of(recorded(("a", STEPS), ("b", STEPS + 0.02), ("c", STEPS + 0.048)))
    np.testing.assert_allclose(found[1:-1], STEPS[1:-1] + 0.068 / 3, atol=1e-9)
    assert len(knots.of(recorded(("a", STEPS), ("b", STEPS + 0.05)))) == 2 * len(STEPS)


def test_cameras_that_take_turns_keep_the_times_of_those_that_record_together():
    times = 0.1 * np.arange(12)
    groups = [[(f"{turn}{k}", times[turn::3]) for k in range(knots.ENOUGH_CAMERAS)] for turn in range(3)]
    assert knots.of(recorded(*sum(groups, []))).tolist() == pytest.approx(times.tolist())
    fewer = [camera for group in groups for camera in group[: knots.ENOUGH_CAMERAS - 1]]
    assert len(knots.of(recorded(*fewer))) < len(times)


def test_two_times_of_one_camera_never_share_a_knot():
    fast, slow = np.arange(0, 1, 0.04), np.arange(0, 1, 0.1)
    found = knots.of(recorded(("a", slow), ("b", slow + 0.01), ("c", slow + 0.02), ("fast", fast)))
    assert len({train_views.nearest_knot(found, t) for t in fast}) == len(fast)
    path = [0.0, 0.1, 0.11, 0.12, 0.3, 0.4]
    moving = recorded(*((f"m@{k}" if k else "m", [t]) for k, t in enumerate(path)))
    assert knots.of(moving).tolist() == path


def test_moving_cameras_share_their_knots():
    seen = recorded(
        *(
            (f"{name}@{k}" if k else name, [t + shift])
            for name, shift in (("m", 0), ("n", 0.03))
            for k, t in enumerate(STEPS)
        )
    )
    np.testing.assert_allclose(knots.of(seen)[1:-1], STEPS[1:-1] + 0.015, atol=1e-9)


def test_too_many_times_are_thinned_to_knots_among_them():
    times = np.concatenate([np.linspace(0, 0.2, 300), np.linspace(0.3, 1, 100)])
    found = knots.of(recorded(("a", times)), limit=40)
    assert len(found) == 40 and np.isin(found, np.round(times, 9)).all() and (np.diff(found) > 0).all()
    assert found[0] == 0 and found[-1] == 1 and (found < 0.25).sum() == pytest.approx(30, abs=1)

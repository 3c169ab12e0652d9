"""Times from a table, choice of frames, splits."""

import csv

import numpy as np
import pytest

from r5dgs_core.errors import ConfigError, DatasetError
from r5dgs_core.prepare import camera_source, data_splits, frame_choice, frame_times
from r5dgs_core.prepare.data_splits import HoldOut
from r5dgs_core.prepare.frame_choice import Window

NAMES = ("a", "b")


def table(path, header, rows):
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])
    return path


def source(name, count):
    return camera_source.CameraSource(name, (), 8, 8, np.arange(count) / 30, "container")


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        (("sync_index", "cam_id", "frame_time"), 1.0),
        (("frame", "camera", "time_ms"), 1e3),
        (("Frame", "Camera", "Timestamp_ns"), 1e9),
    ],
)
def test_a_table_replaces_the_times_of_videos(tmp_path, header, unit):
    rows = [(k, c, (25 + 0.1 * k + 0.01 * c) * unit) for k in (2, 0, 1) for c in (0, 1)]
    path = table(tmp_path / "timestamps.csv", header, rows)
    one, other = frame_times.apply([source("cam_0", 3), source("cam_1", 3)], path)
    np.testing.assert_allclose(one.times, [0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(other.times, [0.01, 0.11, 0.21], atol=1e-6)
    assert one.timing == camera_source.TABLE


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        (("frame", "time"), [(0, 0.0)], "expected the columns camera, frame and time, found frame, time"),
        (("camera", "time"), [], "expected the columns camera, frame and time, found no rows"),
        (("camera", "frame", "time"), [("a", 0, "x")], "line 2: expected a frame number and a time"),
        (("camera", "frame", "time"), [("a", 0, 1), ("a", 1, 1)], "the times of a do not increase"),
        (("camera", "frame", "time"), [("a", 0, 1)], "lists 1 frames of a, which has 2"),
        (("camera", "frame", "time"), [("z", 0, 1)], "expected times of a, found z"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path, header, rows, message):
    with pytest.raises(DatasetError, match=message):
        frame_times.apply([source("a", 2)], table(tmp_path / "timestamps.csv", header, rows))


def test_nearest_frames_are_chosen_and_simultaneous_ones_share_a_time():
    slow, fast = np.arange(5) / 10, 0.0005 + np.arange(20) / 40
    choice = frame_choice.choose(NAMES, [slow, fast], Window())
    assert choice.indices[1].tolist() == [0, 4, 8, 12, 16]
    np.testing.assert_array_equal(choice.times[0], choice.times[1])
    assert choice.interval == pytest.approx(0.1)


def test_frames_that_are_apart_keep_their_times():
    one, other = np.arange(6) / 10, 0.03 + np.arange(6) / 10
    choice = frame_choice.choose(NAMES, [one, other], Window())
    np.testing.assert_allclose(choice.times[1] - choice.times[0], 0.03)


def test_the_first_moment_counts_although_cameras_begin_apart():
    one, other = np.arange(6) / 10, 0.03 + np.arange(6) / 10
    choice = frame_choice.choose(NAMES, [one, other], Window())
    assert choice.indices[0].tolist() == choice.indices[1].tolist() == list(range(6))
    assert frame_choice.choose(NAMES, [one, other], Window(start=0.1)).indices[0].tolist() == [2, 3, 4, 5]


@pytest.mark.parametrize(
    ("window", "expected"),
    [
        (Window(every=3), [0, 3, 6, 9]),
        (Window(start=0.25, end=0.5), [3, 4, 5]),
        (Window(fps=5.0), [0, 2, 4, 6, 8]),
        (Window(fps=1e15), list(range(10))),  # more moments than memory
        (Window(start=0.2, every=2, end=0.7), [2, 4, 6]),
    ],
)
def test_windows_choose_frames(window, expected):
    times = np.arange(10) / 10
    choice = frame_choice.choose(NAMES, [times, times], window)
    assert choice.indices[0].tolist() == choice.indices[1].tolist() == expected


def test_a_shorter_recording_limits_the_others():
    choice = frame_choice.choose(NAMES, [np.arange(100) / 10, 2 + np.arange(10) / 10], Window())
    assert choice.indices[0].tolist() == list(range(20, 30))
    np.testing.assert_allclose(choice.spans, [(0.0, 9.9), (2.0, 2.9)])


def test_a_missing_frame_is_missing_in_its_moment_alone():
    times = np.arange(10) / 10
    choice = frame_choice.choose(NAMES, [times, np.delete(times, 4)], Window())
    assert choice.moments[0].tolist() == list(range(10))
    assert choice.moments[1].tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]


def test_recordings_without_a_common_time_are_refused():
    with pytest.raises(DatasetError, match="no overlap: a ends 4.10 s before b begins"):
        frame_choice.choose(NAMES, [np.arange(10) / 10, 5 + np.arange(10) / 10], Window())


def test_an_empty_window_is_refused():
    times = np.arange(10) / 10
    with pytest.raises(DatasetError, match=r"no frame from 7 s to the end: the cameras record together for 0\.90 s"):
        frame_choice.choose(NAMES, [times, times], Window(start=7.0))


def arranged(**fields):
    times = np.arange(11) / 10
    return data_splits.arrange(NAMES, frame_choice.choose(NAMES, [times, times], Window()), HoldOut(**fields))


def test_by_default_every_frame_trains_and_a_quarter_of_the_clip_follows():
    found = arranged()
    assert set(found.splits[0]) == set(found.splits[1]) == {"train"}
    assert found.t_max == pytest.approx(0.8) and found.times[0][0] == 0.0
    assert found.seconds_per_unit == pytest.approx(1.25) and found.frames_per_unit == pytest.approx(12.5)


def test_held_out_frames_are_in_val_and_later_ones_in_test():
    found = arranged(cameras=("b",), every=3, after=0.8, horizon=0.0)
    assert found.splits[0] == ("train",) * 3 + ("val",) + ("train",) * 2 + ("val",) + ("train",) * 2 + ("test",) * 2
    assert set(found.splits[1][:9]) == {"val"} and set(found.splits[1][9:]) == {"test"}
    assert found.t_max == pytest.approx(0.8) and found.seconds_per_unit == pytest.approx(1.0)


def test_the_horizon_is_given_in_seconds():
    assert arranged(horizon=3.0).t_max == pytest.approx(0.25)


def test_held_out_frames_outside_the_observed_time_are_left_out():
    one, other = np.arange(5) / 10, np.arange(5) / 10 - 0.03
    choice = frame_choice.choose(NAMES, [one, other], Window())
    assert data_splits.arrange(NAMES, choice, HoldOut(cameras=("b",))).splits[1] == ("",) + ("val",) * 4


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cameras": ("c",)}, "--hold-out-camera c: expected one of a, b"),
        ({"cameras": NAMES}, "no frame is left for training"),
    ],
)
def test_impossible_hold_outs_are_refused(fields, message):
    with pytest.raises(ConfigError, match=message):
        arranged(**fields)


def test_options_that_hold_out_nothing_are_refused():
    with pytest.raises(ConfigError, match="--hold-out-after 9: expected a time before the last frame, which"):
        arranged(after=9.0)
    with pytest.raises(ConfigError, match="--hold-out-every 99: expected at most "):
        arranged(every=99)

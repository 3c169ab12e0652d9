"""Stored frames are those that were appended, and their number does not affect memory."""

import gc
import tracemalloc
import warnings
from collections.abc import Iterable

import numpy as np
import pytest

from r5dgs_core.check.capture import over_time
from r5dgs_core.prepare import motion_tracks
from r5dgs_core.prepare.frame_store import FrameStore

RNG = np.random.default_rng(0)


def stored(frames: Iterable[np.ndarray]) -> FrameStore:
    store = FrameStore()
    for frame in frames:
        store.append(frame)
    return store


@pytest.mark.parametrize("dtype", [np.uint8, np.float16])
def test_frames_are_those_that_were_appended(dtype):
    frames = (255 * RNG.random((7, 5, 4, 3))).astype(dtype)
    store = stored(frames[:6].transpose(0, 2, 1, 3))  # not contiguous
    np.testing.assert_array_equal(list(store), frames[:6].transpose(0, 2, 1, 3))
    store.append(frames[6].transpose(1, 0, 2))
    assert len(store) == 7 and store[0].dtype == dtype
    np.testing.assert_array_equal(store[-1], frames[6].transpose(1, 0, 2))
    np.testing.assert_array_equal(store.rows(1, 3), frames.transpose(0, 2, 1, 3)[:, 1:3])
    with pytest.raises(IndexError):
        store[7]


def test_frames_of_another_size_or_type_are_refused():
    store = stored([np.zeros((4, 5), np.uint8)])
    for other in (np.zeros((5, 4), np.uint8), np.zeros((4, 5), np.int16)):
        with pytest.raises(ValueError, match="expected"):
            store.append(other)


def test_the_file_is_closed_with_the_store():
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        store = stored([np.zeros((4, 5), np.uint8)])
        file = store._file
        del store
        gc.collect()
        assert file.closed
        del file
        gc.collect()
    assert not [one for one in found if one.category is ResourceWarning]


def test_the_usual_difference_is_the_median_for_any_number_of_bands(monkeypatch):
    frames = RNG.integers(0, 256, (8, 11, 6, 3), np.uint8)
    behind = motion_tracks.background(frames)
    whole = np.median(np.abs(frames.astype(np.int16) - behind).max(-1), axis=0)
    for band in (1, 8 * 18 * 3, 1 << 21):
        monkeypatch.setattr(over_time, "_BAND", band)
        np.testing.assert_array_equal(over_time._usual_difference(stored(frames), behind), whole)


def test_memory_does_not_grow_with_the_number_of_frames():
    noise = RNG.integers(0, 256, (32, 240, 3), np.uint8)
    peaks = []
    for count in (100, 400):
        tracemalloc.start()
        store = stored(np.roll(noise, 3 * k, axis=1) for k in range(count))
        motion_tracks.centers(store)
        over_time._usual_difference(store, motion_tracks.background(store))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 10 * noise.nbytes  # of 300 more frames

"""Offsets between clocks are recovered from sound and from motion, and are not invented."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

from r5dgs_core import errors
from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.data import masks
from r5dgs_core.prepare import cameras, clock, clocks, motion_offsets, motion_tracks
from tests.support import recordings

CLOCKS = (0.0, 0.0071, -0.0133)  # seconds
STARTS = (0.5, 0.503, 0.511)


PATHS = {  # positions of objects at a time
    1: recordings.ball,
    2: lambda t: np.array([0.6 * np.cos(2.9 * t), 0.5 * np.sin(2.2 * t), 0.3 + 0.2 * np.cos(4 * t)]),
}


def tracks_of(camera, times, shift, paths):
    """Exact tracks of objects in a camera whose clock is late."""
    tracks = {}
    for key, path in paths.items():
        seen = np.stack([path(t + shift) for t in times])
        local = seen @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
        points = local[:, :2] / local[:, 2:]
        tracks[key] = motion_tracks.MotionTrack(times, points, 1 / camera.intrinsics[0, 0], np.zeros(len(times)))
    return tracks


def draw_nothing(camera, lens, t):
    return np.zeros((32, 48, 3), np.uint8)


def measured(folder, method="auto", given=None, calibration=None):
    opened, found = cameras.open_all(folder, calibration, None)
    calibrated = [camera.calibrated for camera in opened]
    return clocks.offsets(
        [camera.source for camera in opened], found, calibrated, method, given or {}, lambda event: None
    )


@pytest.fixture(scope="module")
def swinging(tmp_path_factory):
    """Three cameras that see a swinging ball, with clocks that differ."""
    rig = recordings.make_rig(3, 256, 192, (-0.1, 0.02, 0.001, -0.001, 0.0))
    times = [start + np.arange(90) / 30 for start in STARTS]
    return recordings.record(tmp_path_factory.mktemp("swinging"), rig, times, recordings.draw_ball, clocks=CLOCKS)


def test_motion_gives_offsets_to_a_millisecond_and_says_how_sure_they_are(swinging):
    found, notes = measured(swinging)
    assert notes == [] and {one.method for one in found} == {"motion"}
    for one, truth in zip(found, CLOCKS, strict=True):
        assert abs(one.seconds - truth) < 1e-3
        assert abs(one.seconds - truth) < 3 * one.sigma + 1e-12 and one.sigma < 2e-3


def test_cameras_in_step_keep_their_times(tmp_path):
    rig = recordings.make_rig(3, 192, 144)
    recordings.record(tmp_path, rig, [np.arange(60) / 30] * 3, recordings.draw_ball)
    found, notes = measured(tmp_path)
    assert [one.seconds for one in found] == [0.0, 0.0, 0.0] and notes == []
    assert all(one.sigma is not None for one in found)


def test_without_motion_nothing_is_invented(tmp_path):
    rig = recordings.make_rig(2, 96, 72)
    recordings.record(
        tmp_path, rig, [np.arange(20) / 30] * 2, lambda camera, lens, t: recordings.draw_ball(camera, lens, 0.0)
    )
    found, notes = measured(tmp_path)
    assert [one.sigma for one in found] == [None, None] and "too little moves" in notes[0]


def sounds(shifts, seconds=4.0):
    """Clicks and noise as heard by each camera from its own start on."""
    rate = recordings.SOUND_RATE
    rng = np.random.default_rng(3)
    clicks = (rng.uniform(size=int((seconds + 2) * rate)) < 8 / rate) * rng.normal(size=int((seconds + 2) * rate))
    heard = signal.lfilter([1.0], [1.0, -0.95], clicks).astype(np.float32)
    result = []
    for shift in shifts:
        first = round((1.0 + shift) * rate)
        part = heard[first : first + int(seconds * rate)]
        result.append((0.3 * part / np.abs(heard).max() + rng.normal(size=len(part)) * 1e-3).astype(np.float32))
    return result


def test_sound_gives_offsets_of_cameras_that_started_far_apart(tmp_path):
    shifts = (0.0, 0.4137, -0.2511)  # start of each recording
    rig = recordings.make_rig(3, 48, 32)
    times = [np.arange(100) / 25] * 3
    recordings.record(tmp_path, rig, times, draw_nothing, sound=sounds(shifts))
    found, _ = measured(tmp_path)
    assert {one.method for one in found} == {"audio"}
    for one, truth in zip(found, shifts, strict=True):
        assert abs(one.seconds - truth) < 1e-3


def test_unrelated_sounds_are_not_compared(tmp_path):
    rng = np.random.default_rng(0)
    rig = recordings.make_rig(2, 48, 32)
    noise = [rng.normal(size=2 * recordings.SOUND_RATE).astype(np.float32) * 0.1 for _ in range(2)]
    recordings.record(tmp_path, rig, [np.arange(50) / 25] * 2, draw_nothing, sound=noise)
    with pytest.raises(errors.ConfigError, match="the cameras' sounds do not match"):
        measured(tmp_path, "audio")


def test_given_offsets_are_used_as_they_are(swinging):
    found, _ = measured(swinging, given={"cam1": 0.25})
    assert [one.seconds for one in found] == [0.0, 0.25, 0.0] and found[1].method == "given"
    with pytest.raises(errors.ConfigError, match="--offset cam9: expected one of cam0, cam1, cam2"):
        measured(swinging, given={"cam9": 0.25})


def test_sound_that_is_missing_is_named(swinging):
    with pytest.raises(errors.ConfigError, match="--sync audio: cam0 has no sound"):
        measured(swinging, "audio")


def test_one_wrong_pair_does_not_spoil_the_offsets():
    truth = np.array([0.0, 0.1, -0.2, 0.05])
    pairs = [(a, b, truth[b] - truth[a], 0.001) for a in range(4) for b in range(a + 1, 4)]
    pairs[2] = (0, 3, 1.0, 0.001)
    found = clock.solve_pairs(4, pairs, "motion")
    np.testing.assert_allclose([one.seconds for one in found], truth, atol=0.01)


def test_cameras_that_no_pair_connects_have_no_uncertainty():
    found = clock.solve_pairs(4, [(1, 2, 0.1, 0.01)], "motion")
    assert [one.sigma is None for one in found] == [True, False, False, True]
    assert found[2].seconds == pytest.approx(0.1)
    assert clock.solve_pairs(3, [], "motion") is None


def test_the_misfit_is_least_at_the_true_offsets():
    rig, times = recordings.make_rig(2, 320, 240), np.arange(80) / 30
    pairs = zip(rig.cameras, (0.0, 0.02), strict=True)
    tracks = [tracks_of(camera, times, shift, {0: recordings.ball}) for camera, shift in pairs]
    poses = [camera.T_cam_world for camera in rig.cameras]
    found = motion_offsets.measure(tracks, poses, [1 / 30, 1 / 30])
    assert found[1].seconds == pytest.approx(0.02, abs=3e-4)
    at = [motion_offsets.misfit(tracks, poses, 1 / 30, np.array([0.0, value])) for value in (0.0, 0.02, 0.04)]
    assert at[1] < 0.1 * min(at[0], at[2])


def test_objects_are_compared_with_themselves():
    rig, times = recordings.make_rig(4, 320, 240), np.arange(30) / 30
    shifts, shown = (0.0, 0.006, -0.009, 0.012), ((1, 2), (1,), (1, 2), (2,))
    tracks = [
        tracks_of(camera, times, shift, {key: PATHS[key] for key in keys})
        for camera, shift, keys in zip(rig.cameras, shifts, shown, strict=True)
    ]
    found = motion_offsets.measure(tracks, [camera.T_cam_world for camera in rig.cameras], [1 / 30] * 4)
    np.testing.assert_allclose([one.seconds for one in found], shifts, atol=5e-4)


def test_a_camera_that_cannot_be_compared_gets_the_median_of_the_others():
    sources = [SimpleNamespace(name=f"cam{k}", interval=1 / 30) for k in range(4)]
    found = [clock.Offset(seconds, sigma, "motion") for seconds, sigma in ((0, 0.0), (0.01, 1e-3), (0.012, 1e-3))]
    result, notes = clocks._significant(sources, [*found, clock.Offset(0.0, None, "none")])
    assert result[:3] == found and result[3] == clock.Offset(0.01, None, "none")
    assert notes == ["cam3: its clock could not be compared with the others; their median +10.0 ms is used"]
    small = [clock.Offset(one.seconds / 10, one.sigma, "motion") for one in found]
    result, notes = clocks._significant(sources, [*small, clock.Offset(0.0, None, "none")])
    assert [one.seconds for one in result] == [0.0] * 4 and "offset 0 is used" in notes[0]


def steady_tracks(rig, times):
    """Tracks of an object that moves steadily, with noise."""
    rng = np.random.default_rng(0)
    paths = {1: lambda t: np.array([0.5 * t, 0.3 * t, 0.2])}
    tracks = [tracks_of(camera, times, 0.0, paths) for camera in rig.cameras]
    for track in tracks:
        track[1].points[:] += rng.normal(0, 0.3 * track[1].pixel, track[1].points.shape)
    return tracks


def test_steady_motion_gives_no_offset():
    rig = recordings.make_rig(3, 320, 240)
    tracks = steady_tracks(rig, np.arange(40) / 30)
    assert motion_offsets.measure(tracks, [camera.T_cam_world for camera in rig.cameras], [1 / 30] * 3) is None


def test_moving_regions_are_tried_if_the_objects_of_masks_move_steadily(monkeypatch):
    rig, times = recordings.make_rig(3, 320, 240), np.arange(40) / 30
    shifts = (0.0, 0.006, -0.009)
    given = zip(rig.cameras, shifts, strict=True)
    swinging = [tracks_of(camera, times, shift, {0: recordings.ball}) for camera, shift in given]
    monkeypatch.setattr(clocks, "_masked_tracks", lambda *arguments: steady_tracks(rig, times))
    monkeypatch.setattr(clocks, "_moving_regions", lambda *arguments: swinging)
    sources = [SimpleNamespace(name=camera.name, interval=1 / 30) for camera in rig.cameras]
    found, notes = clocks._by_motion(sources, rig.cameras, lambda event: None, Path("masks"))
    np.testing.assert_allclose([one.seconds for one in found], shifts, atol=5e-4)
    assert notes == []


def test_objects_are_followed_while_all_of_them_is_visible():
    source = SimpleNamespace(times=np.arange(20) / 30, width=120, height=80)
    frames = np.zeros((20, 40, 60), np.int32)  # half of the size of the frames
    for k in range(20):
        frames[k, 10:20, 2 * k : 2 * k + 10] = 7  # begins at the left edge
        frames[k, 5:25, 45:50] = 9  # at rest; the other one arrives at it
    files = {k: Path(f"{k}.png") for k in range(20)}
    lens = Lens("pinhole", 100.0, 100.0, 60.0, 40.0)
    found = motion_tracks.of_masks(source, lens, files, lambda path: frames[int(path.stem)])
    assert found.keys() == {7}
    np.testing.assert_allclose(found[7].times * 30, np.arange(1, 18), atol=1e-9)
    np.testing.assert_allclose(found[7].points[:, 0] * 100 + 60, 2 * (2 * np.arange(1, 18) + 5))
    np.testing.assert_allclose(found[7].points[:, 1] * 100 + 40, 30)


def test_masks_of_the_frames_replace_the_largest_moving_region(swinging, tmp_path):
    opened, calibration = cameras.open_all(swinging, None, None)
    for camera, start in zip(opened, STARTS, strict=True):
        lens, pose = camera.calibrated.lens, camera.calibrated.T_cam_world
        v, u = np.mgrid[: camera.source.height, : camera.source.width] + 0.5
        for k in range(len(camera.source.times)):
            center = pose[:3, :3] @ recordings.ball(start + k / 30) + pose[:3, 3]
            (x, y), radius = lens.project(center[None])[0], 0.22 * lens.fx / center[2]
            ids = ((u - x) ** 2 + (v - y) ** 2 < radius**2).astype(np.uint16)
            masks.write(tmp_path / camera.name / f"{k:06d}.png", ids)
    found, _ = clocks.offsets(
        [camera.source for camera in opened],
        calibration,
        [camera.calibrated for camera in opened],
        "motion",
        {},
        lambda event: pytest.fail("no frame is read"),
        tmp_path,
    )
    np.testing.assert_allclose([one.seconds for one in found], CLOCKS, atol=1e-3)


def test_the_uncertainty_of_a_table_is_the_irregularity_of_its_times():
    rng = np.random.default_rng(0)
    even = 3.0 + np.arange(2000) / 6
    assert clock.irregularity(even) == pytest.approx(0, abs=1e-9)
    noisy = even + 0.004 * rng.normal(size=len(even))
    assert clock.irregularity(noisy) == pytest.approx(0.004, rel=0.1)
    assert clock.irregularity(np.delete(noisy, slice(500, 520))) == pytest.approx(0.004, rel=0.1)
    assert clock.irregularity(even[:2]) == 0.0


def test_cameras_of_a_table_keep_their_times_and_get_its_irregularity(tmp_path):
    even = np.arange(20) / 10
    jitter = 0.003 * np.random.default_rng(1).normal(size=len(even))
    recordings.record(tmp_path, recordings.make_rig(2, 48, 32), [even] * 2, draw_nothing)
    rows = [f"cam0,{k},{t}" for k, t in enumerate(even)] + [f"cam1,{k},{t}" for k, t in enumerate(even + jitter)]
    (tmp_path / "timestamps.csv").write_text("\n".join(["camera,frame,time", *rows]))
    found, notes = measured(tmp_path)
    assert [one.seconds for one in found] == [0.0, 0.0] and notes == []
    assert found[0].sigma < 1e-6 and 0.0015 < found[1].sigma < 0.0045

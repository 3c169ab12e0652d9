"""Cameras from a board that is carried around, in drawn pictures with exact poses."""

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.reconstruction import board, reconstruct
from r5dgs_core.capture.reconstruction.board import Board
from r5dgs_core.capture.reconstruction.request import Request
from tests.support.board_films import APRILTAG, CHARUCO, LENSES, POSES, TIMES, carried, films
from tests.support.room import pose_errors


@pytest.mark.parametrize("kind", [CHARUCO, APRILTAG])
def test_corners_are_found_without_an_offset(kind):
    detector = board.Detector(board.parse(kind))
    misses = []
    for film, lens, pose in zip(films(kind, times=3), LENSES, POSES, strict=True):
        for time, frame in enumerate(film.frames):
            rows, pixels = detector.detect(frame)
            view = np.linalg.inv(pose) @ carried(time)
            misses.append(pixels - lens.project(detector.points[rows] @ view[:3, :3].T + view[:3, 3]))
    misses = np.concatenate(misses)
    assert len(misses) > 50 and np.abs(np.median(misses, axis=0)).max() < 0.1


@pytest.mark.default_cases(f"True-{CHARUCO}", f"True-{APRILTAG}")
@pytest.mark.parametrize("kind", [CHARUCO, APRILTAG])
@pytest.mark.parametrize("known", [True, False])
def test_a_carried_board_gives_poses_lenses_and_the_scale(tmp_path, kind, known):
    recordings = films(kind)
    lenses = {f"cam{k}": lens for k, lens in enumerate(LENSES)} if known else {}
    found = reconstruct.reconstruct(recordings, Request(board=board.parse(kind), lenses=lenses), tmp_path / "work")
    shifts, angles = pose_errors([camera.camera_to_world for camera in found.cameras], POSES)
    assert shifts.max() < (0.003 if known else 0.02) and angles.max() < (0.15 if known else 0.6)
    apart = np.linalg.norm(found.cameras[0].camera_to_world[:3, 3] - found.cameras[2].camera_to_world[:3, 3])
    assert apart == pytest.approx(np.linalg.norm(POSES[0][:3, 3] - POSES[2][:3, 3]), rel=0.01)
    assert found.meters_per_unit == 1.0
    for camera, lens in zip(found.cameras, LENSES, strict=True):
        assert camera.lens.fx == pytest.approx(lens.fx, rel=1e-9 if known else 0.02)


def test_cameras_that_never_see_the_board_together_are_named(tmp_path):
    late, early = set(range(6, TIMES)), set(range(6))
    recordings = films(CHARUCO, unseen={0: late, 1: late, 2: early})
    lenses = {f"cam{k}": lens for k, lens in enumerate(LENSES)}
    with pytest.raises(errors.DatasetError, match=r"cameras cam2 \(together with cam\d at 0 times.*carry the board"):
        reconstruct.reconstruct(recordings, Request(board=board.parse(CHARUCO), lenses=lenses), tmp_path)


def test_cameras_that_do_not_see_the_board_are_named(tmp_path):
    recordings, events = films(CHARUCO, times=3, unseen={1: {0, 1, 2}}), []
    with pytest.raises(errors.DatasetError, match="cameras cam1: the board was not found"):
        reconstruct.reconstruct(recordings, Request(board=board.parse(CHARUCO)), tmp_path, events.append)
    assert [(event["event"], event["done"], event["total"]) for event in events] == [
        ("board", k, 9) for k in range(1, 10)
    ]
    assert [event["text"] for event in events[::3]] == ["cam0", "cam1", "cam2"]


def test_a_lens_needs_several_views(tmp_path):
    recordings = films(CHARUCO, times=4)
    with pytest.raises(errors.DatasetError, match="camera 'cam0': the board is seen in 4 frames, expected 6"):
        reconstruct.reconstruct(recordings, Request(board=board.parse(CHARUCO)), tmp_path)


def test_moving_cameras_are_not_solved_by_a_board(tmp_path):
    request = Request(board=board.parse(CHARUCO), moving=frozenset({"cam0"}))
    with pytest.raises(errors.ConfigError, match="expected fixed cameras"):
        reconstruct.reconstruct(films(CHARUCO, times=1), request, tmp_path)


def test_unknown_cameras_in_the_request_are_refused(tmp_path):
    with pytest.raises(errors.ConfigError, match="cameras cam9: unknown; the recordings are cam0, cam1, cam2"):
        reconstruct.reconstruct(films(CHARUCO, times=1), Request(moving=frozenset({"cam9"})), tmp_path)


def test_descriptions_of_boards(tmp_path):
    assert board.parse(CHARUCO) == Board("charuco", 5, 4, 0.1, 0.075, "DICT_4X4_50")
    assert board.parse(APRILTAG) == Board("apriltag", 3, 2, 0.14, 0.04, "DICT_APRILTAG_36h11")
    path = tmp_path / "charuco.toml"
    path.write_text(
        'columns = 4\nrows = 5\ndictionary = "DICT_4X4_1000"\naruco_scale = 0.75\nsquare_size_override_cm = 5.4\n'
    )
    read = board.parse(str(path))
    assert (read.columns, read.rows, read.dictionary) == (4, 5, "DICT_4X4_1000")
    assert (read.length, read.detail) == pytest.approx((0.054, 0.0405))


@pytest.mark.parametrize(
    "text, message",
    [
        ("chess:5x4:0.1:0.05:4X4_50", "expected charuco:COLUMNSxROWS"),
        ("charuco:5x4:0.1:0.05", "expected charuco:COLUMNSxROWS"),
        ("charuco:5x4:1.0.0:0.05:4X4_50", "expected charuco:COLUMNSxROWS"),
        ("charuco:5x4:0.1:0.2:4X4_50", "markers that are smaller than their squares"),
        ("charuco:5x4:0:0.2:4X4_50", "expected positive lengths"),
    ],
)
def test_other_descriptions_are_refused(text, message):
    with pytest.raises(errors.ConfigError, match=message):
        board.parse(text)


@pytest.mark.parametrize(
    "text, message",
    [("charuco:5x4:0.1:0.05:9X9_50", "unknown dictionary"), ("charuco:20x20:0.1:0.05:4X4_50", "fewer than")],
)
def test_dictionaries_that_do_not_fit_are_refused(text, message):
    with pytest.raises(errors.ConfigError, match=message):
        board.Detector(board.parse(text))

"""Calibrated cameras: resized, and moved to another world."""

from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration.calibration import CalibratedCamera, CalibratedFrame, Calibration
from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.motion import rotations

LENS = Lens("brown", 300.0, 301.0, 161.0, 119.0, (-0.1, 0.01, 0.0, 0.0))


def pose(turn: tuple[float, float, float], place: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array(turn)))
    matrix[:3, 3] = place
    return matrix


def camera() -> CalibratedCamera:
    poses = pose((0.1, 0.2, 0.3), (1.0, 2.0, -3.0)), pose((0.2, 0.2, 0.3), (1.0, 2.5, -3.0))
    frames = tuple(CalibratedFrame(Path(f"{k}.png"), k / 10, LENS, matrix) for k, matrix in enumerate(poses))
    return CalibratedCamera("a", 320, 240, LENS, poses[0], frames)


def test_a_camera_moves_if_the_poses_of_its_frames_differ():
    moving = camera()
    assert moving.moves
    assert not CalibratedCamera("a", 320, 240, LENS, moving.camera_to_world, moving.frames[:1] * 2).moves


def test_resized_cameras_see_the_same_directions():
    half = camera().resized(160, 120)
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]])
    assert np.allclose(half.lens.project(points), LENS.project(points) / 2)
    assert np.allclose(half.frames[1].lens.project(points), LENS.project(points) / 2)
    assert (half.width, half.height) == (160, 120)


def test_cameras_of_unknown_size_keep_their_lens():
    unknown = CalibratedCamera("a", 0, 0, LENS, np.eye(4)).resized(640, 360)
    assert unknown.lens == LENS and (unknown.width, unknown.height) == (640, 360)


@pytest.mark.parametrize("size, message", [((240, 320), "images are turned"), ((320, 180), "uncropped")])
def test_images_of_another_aspect_ratio_are_refused(size, message):
    with pytest.raises(errors.DatasetError, match=message):
        camera().resized(*size)


def test_a_moved_world_is_seen_in_the_same_pixels():
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    old = Calibration((camera(),), 1.0, "caliscope", Path("x"), points=points)
    turn = pose((0.5, -1.0, 0.2), (0, 0, 0))[:3, :3]
    new = old.moved(turn, np.array([3.0, -2.0, 1.0]), 100.0)
    assert new.meters_per_unit == pytest.approx(0.01)

    def seen(matrix: np.ndarray, places: np.ndarray) -> np.ndarray:
        return LENS.project((places - matrix[:3, 3]) @ matrix[:3, :3])

    assert np.allclose(new.points, 100 * points @ turn.T + [3, -2, 1])
    for a, b in zip(old.cameras[0].frames, new.cameras[0].frames, strict=True):
        assert np.allclose(seen(a.camera_to_world, points), seen(b.camera_to_world, new.points), equal_nan=True)
    assert np.allclose(new.cameras[0].camera_to_world, new.cameras[0].frames[0].camera_to_world)

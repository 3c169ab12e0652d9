"""nerfstudio's camera files against OpenCV, COLMAP and the formulas of nerfstudio."""

import json

import cv2
import numpy as np
import pycolmap
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from r5dgs_core.data import images
from tests.support.projections import BOUND, POINTS, pixels, rotation

MATRIX = np.array([[503.5, 0, 321.5], [0, 501.5, 238.5], [0, 0, 1]])
LENS = {"fl_x": 503.5, "fl_y": 501.5, "cx": 321.5, "cy": 238.5, "w": 640, "h": 480}
ARIA = (-0.02, 0.01, 2e-3, -1e-3, 5e-4, -1e-4, 2e-3, -3e-3, 1e-3, -5e-4, 2e-3, 7e-4)


def pose(k: int) -> np.ndarray:
    """Camera to world, OpenGL axes."""
    turn = rotation(k + 1)
    return np.block([[turn, turn @ [[0.1 * k], [-0.1], [2.0]]], [np.zeros((1, 3)), np.ones((1, 1))]])


def write(folder, frames, name="transforms.json", **top):
    content = {**top, "frames": [{"transform_matrix": pose(k).tolist(), **frame} for k, frame in enumerate(frames)]}
    (folder / name).write_text(json.dumps(content))


def in_camera(k: int) -> np.ndarray:
    world_to_camera = np.diag([1, -1, -1, 1]) @ np.linalg.inv(pose(k))
    return POINTS @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]


def opencv(points: np.ndarray, *coefficients: float) -> np.ndarray:
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0][:, 0]


def opencv_fisheye(points: np.ndarray, *coefficients: float) -> np.ndarray:
    return cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0][:, 0]


def colmap(points: np.ndarray, model: str, *coefficients: float) -> np.ndarray:
    parameters = [503.5, 501.5, 321.5, 238.5, *coefficients]
    return np.array(pycolmap.Camera(model=model, width=640, height=480, params=parameters).img_from_cam(points))


def polynomial(points: np.ndarray, k1, k2, k3, k4, p1, p2) -> np.ndarray:
    """The perspective lens of nerfstudio: k4 is the factor of r^8."""
    x, y = (points[:, :2] / points[:, 2:]).T
    r = x * x + y * y
    d = 1.0 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    u = d * x + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    v = d * y + 2 * p2 * x * y + p1 * (r + 2 * y * y)
    return np.stack([503.5 * u + 321.5, 501.5 * v + 238.5], 1)


# keys of the file, and the pixels of points in camera axes; 0.5 is a centre of the first pixel in both
LENSES = {
    "OPENCV": ({"k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -2e-3}, lambda p: opencv(p, -0.2, 0.05, 1e-3, -2e-3)),
    "OPENCV k3": ({"k1": -0.2, "k2": 0.05, "k3": 0.01}, lambda p: opencv(p, -0.2, 0.05, 0, 0, 0.01)),
    "OPENCV k4": (
        {"k1": -0.2, "k2": 0.05, "k3": 0.01, "k4": 0.02, "p1": 1e-3, "p2": -2e-3},
        lambda p: polynomial(p, -0.2, 0.05, 0.01, 0.02, 1e-3, -2e-3),
    ),
    "OPENCV listed": (
        {"distortion_params": [-0.2, 0.05, 0.01, 0.02, 1e-3, -2e-3]},
        lambda p: polynomial(p, -0.2, 0.05, 0.01, 0.02, 1e-3, -2e-3),
    ),
    "FULL_OPENCV": (
        {"k1": -0.2, "k2": 0.05, "k3": 0.01, "k4": 0.02, "k5": -0.01, "k6": 3e-3, "p1": 1e-3, "p2": -2e-3},
        lambda p: opencv(p, -0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, -0.01, 3e-3),
    ),
    "PINHOLE": ({}, lambda p: opencv(p, 0, 0, 0, 0)),
    "OPENCV_FISHEYE": (
        {"k1": -0.02, "k2": 0.01, "k3": -4e-3, "k4": 1e-3},
        lambda p: opencv_fisheye(p, -0.02, 0.01, -4e-3, 1e-3),
    ),
    "OPENCV_FISHEYE p1": (
        {"k1": -0.02, "k2": 0.01, "k3": -4e-3, "k4": 1e-3, "p1": 1e-3, "p2": -2e-3},
        lambda p: colmap(p, "THIN_PRISM_FISHEYE", -0.02, 0.01, 1e-3, -2e-3, -4e-3, 1e-3, 0, 0),
    ),
    "FISHEYE624": ({"distortion_params": ARIA}, lambda p: colmap(p, "RAD_TAN_THIN_PRISM_FISHEYE", *ARIA)),
}


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("name", LENSES)
def test_lenses_project_as_their_definition(tmp_path, name, per_frame):
    keys, expected = LENSES[name]
    frames = [{"file_path": f"images/{k}.png", **({**LENS, **keys} if per_frame else {})} for k in range(3)]
    write(tmp_path, frames, camera_model=name.split()[0], **({} if per_frame else {**LENS, **keys}))
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.names) == ("nerfstudio", ("images",))
    for k, frame in enumerate(calibration.cameras[0].frames):
        assert np.abs(pixels(frame.lens, frame.camera_to_world) - expected(in_camera(k))).max() < BOUND
        assert frame.path == tmp_path / "images" / f"{k}.png" and frame.time is None


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "VR180_L", "ORTHOPHOTO", "nonsense"])
def test_other_camera_models_are_refused_by_name(tmp_path, model):
    write(tmp_path, [{"file_path": "a.png"}], camera_model=model, **LENS)
    with pytest.raises(errors.DatasetError, match=f"camera model '{model}' is not supported. Remedy: "):
        reading.read_calibration(tmp_path)


def test_instant_ngp_marks_fisheye_lenses(tmp_path):
    write(tmp_path, [{"file_path": "a.png"}], is_fisheye=True, k1=-0.02, **LENS)
    assert reading.read_calibration(tmp_path).cameras[0].lens.model == "fisheye"


def test_the_size_comes_from_the_image_if_the_file_has_none(tmp_path):
    images.write_png(tmp_path / "images" / "a.png", np.zeros((480, 640, 3), np.uint8))
    write(tmp_path, [{"file_path": "images/a"}], camera_angle_x=1.0)
    (camera,) = reading.read_calibration(tmp_path).cameras
    assert (camera.width, camera.height) == (640, 480)
    assert camera.lens.fx == pytest.approx(320 / np.tan(0.5)) and camera.lens.cx == 320
    assert camera.frames[0].path == tmp_path / "images" / "a.png"


def test_frames_of_named_cameras_are_sorted_into_them(tmp_path):
    frames = [{"file_path": f"f{k}.png", "time": k / 4, "view": "ab"[k % 2]} for k in range(4)]
    write(tmp_path, frames, name="transforms_train.json", **LENS)
    write(tmp_path, [{"file_path": "g.png", "time": 0.5, "view": "c"}], name="transforms_val.json", **LENS)
    calibration = reading.read_calibration(tmp_path)
    assert calibration.names == ("a", "b", "c")
    assert [frame.time for frame in calibration.cameras[1].frames] == [0.25, 0.75]
    assert [camera.frames[0].split for camera in calibration.cameras] == ["train", "train", "val"]


def test_frames_of_one_folder_that_share_poses_are_fixed_cameras(tmp_path):
    frames = [{"file_path": f"f{k}.png", "time": k / 3, "transform_matrix": pose(k % 2).tolist()} for k in range(4)]
    write(tmp_path, frames, **LENS)
    calibration = reading.read_calibration(tmp_path)
    assert len(calibration.cameras) == 2 and not any(camera.moves for camera in calibration.cameras)
    assert [len(camera.frames) for camera in calibration.cameras] == [2, 2]


def test_frames_of_one_folder_at_one_time_are_fixed_cameras(tmp_path):
    write(tmp_path, [{"file_path": f"f{k}.png", "time": 0.0} for k in range(3)], **LENS)
    assert len(reading.read_calibration(tmp_path).cameras) == 3


def test_listed_splits_are_used(tmp_path):
    frames = [{"file_path": f"images/{k}.png"} for k in range(3)]
    write(tmp_path, frames, train_filenames=["images/0.png", "images/1.png"], test_filenames=["images/2.png"], **LENS)
    (camera,) = reading.read_calibration(tmp_path).cameras
    assert [frame.split for frame in camera.frames] == ["train", "train", "test"]


@pytest.mark.parametrize(
    "top, message",
    [
        ({**LENS, "k5": 0.1}, "k5 and k6 need the camera_model FULL_OPENCV"),
        ({**LENS, "camera_model": "FISHEYE624"}, "'distortion_params': expected"),
        ({**LENS, "w": 640.5}, "expected an image size in whole pixels"),
        ({"w": 640, "h": 480}, "expected 'camera_angle_x' or 'fl_x'"),
        ({"fl_x": 500.0}, "the image is missing"),
    ],
)
def test_damaged_files_are_refused(tmp_path, top, message):
    write(tmp_path, [{"file_path": "a.png"}], **top)
    with pytest.raises(errors.DatasetError, match=message):
        reading.read_calibration(tmp_path)

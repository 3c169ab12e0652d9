"""caliscope, anipose and Pose2Sim, read and compared with OpenCV."""

import cv2
import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading

CAMERAS = [
    {
        "r": (0.3, -0.2, 0.1),
        "t": (0.1, -0.2, 2.0),
        "k": (300.5, 301.5, 160.2, 121.7),
        "d": (-0.2, 0.05, 1e-3, -2e-3, 0.01),
    },
    {"r": (-1.5, 1.0, 2.1), "t": (-0.4, 0.3, 2.5), "k": (310.0, 309.0, 158.0, 118.0), "d": (0.1, -0.1, 0.0, 0.0, 0.03)},
]
POINTS = np.random.default_rng(3).uniform(-0.3, 0.3, (50, 3))


def table(header: str, camera: dict, matrix: bool = False, name: str = "", more: str = "") -> str:
    fx, fy, cx, cy = camera["k"]
    rotation = cv2.Rodrigues(np.array(camera["r"]))[0].tolist() if matrix else list(camera["r"])
    return (
        f"[{header}]\n{name}size = [320, 240]\nmatrix = [[{fx}, 0.0, {cx}], [0.0, {fy}, {cy}], [0.0, 0.0, 1.0]]\n"
        f"distortions = {list(camera['d'])}\nrotation = {rotation}\ntranslation = {list(camera['t'])}\n{more}\n"
    )


def expected_pixels(camera: dict) -> np.ndarray:
    fx, fy, cx, cy = camera["k"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return cv2.projectPoints(POINTS, np.array(camera["r"]), np.array(camera["t"]), matrix, np.array(camera["d"]))[0][
        :, 0
    ]


def check_projection(calibration) -> None:
    for camera, given in zip(calibration.cameras, CAMERAS, strict=True):
        p_cam = POINTS @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
        assert np.abs(camera.lens.project(p_cam) - 0.5 - expected_pixels(given)).max() < 0.01
        assert (camera.width, camera.height) == (320, 240)


@pytest.mark.parametrize("matrix", [False, True])
def test_caliscope_files_project_as_opencv(tmp_path, matrix):
    text = "".join(table(f"cameras.{k}", camera, matrix) for k, camera in enumerate(CAMERAS))
    text += "[cameras.7]\nignore = true\nsize = [320, 240]\n[cameras.8]\nsize = [320, 240]\n"
    (tmp_path / "camera_array.toml").write_text(text)
    calibration = reading.read_calibration(tmp_path)
    check_projection(calibration)
    assert calibration.names == ("cam_0", "cam_1")
    assert (calibration.format, calibration.meters_per_unit) == ("caliscope", 1.0)


def test_anipose_files_project_as_opencv(tmp_path):
    text = "".join(table(f"cam_{k}", camera, name=f'name = "side{k}"\n') for k, camera in enumerate(CAMERAS))
    (tmp_path / "calibration.toml").write_text(text + "[metadata]\nadjusted = false\nerror = 0.3\n")
    calibration = reading.read_calibration(tmp_path / "calibration.toml")
    check_projection(calibration)
    assert calibration.names == ("side0", "side1")
    assert (calibration.format, calibration.meters_per_unit) == ("anipose", None)


def test_pose2sim_files_project_as_opencv(tmp_path):
    text = "".join(
        table(f"cam_0{k}", {**camera, "d": camera["d"][:4]}, more="fisheye = false") for k, camera in enumerate(CAMERAS)
    )
    (tmp_path / "Calib_scene.toml").write_text(text)
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.meters_per_unit) == ("pose2sim", 1.0)
    assert calibration.names == ("cam_00", "cam_01")
    assert calibration.cameras[0].lens.coefficients == CAMERAS[0]["d"][:4]


def test_fisheye_cameras_project_as_opencv(tmp_path):
    camera = {**CAMERAS[0], "d": (0.03, -0.01, 0.002, 0.0)}
    (tmp_path / "calibration.toml").write_text(table("cam_0", camera, more="fisheye = true"))
    (read,) = reading.read_calibration(tmp_path).cameras
    fx, fy, cx, cy = camera["k"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    arguments = np.array(camera["r"]), np.array(camera["t"]), matrix, np.array(camera["d"])
    expected = cv2.fisheye.projectPoints(POINTS[:, None], *arguments)[0][:, 0]
    p_cam = POINTS @ read.T_cam_world[:3, :3].T + read.T_cam_world[:3, 3]
    assert np.abs(read.lens.project(p_cam) - 0.5 - expected).max() < 0.01


@pytest.mark.parametrize(
    "change, message",
    [
        (("size = [320, 240]", "size = [320.5, 240]"), "camera 0: expected an image size in whole pixels"),
        (("matrix = ", "matrix = 3 # "), "camera 0: 'matrix': expected 3x3 numbers"),
        (("rotation = [0.3, -0.2, 0.1]", "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]"), "expected a rotation matrix"),
        (("distortions = [-0.2, 0.05,", "distortions = [-0.2, 0.05, 0.1,"), "coefficients, found 6"),
        (("translation = [0.1", "translation = [nan"), "'translation': expected finite numbers"),
        (("[cameras.0]", "[cameras.0"), "not valid TOML"),
        (("300.5", "-300.5"), "focal lengths above 0"),
        (("[cameras.0]", "[others.0]"), "expected the table 'cameras'"),
    ],
)
def test_damaged_files_are_refused_by_place(tmp_path, change, message):
    path = tmp_path / "camera_array.toml"
    text = table("cameras.0", CAMERAS[0])
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(errors.DatasetError, match=message) as caught:
        reading.read_calibration(tmp_path)
    assert str(path) in str(caught.value)


def test_two_cameras_of_one_name_are_refused(tmp_path):
    text = "".join(table(f"cam_{k}", camera, name='name = "left"\n') for k, camera in enumerate(CAMERAS))
    (tmp_path / "calibration.toml").write_text(text)
    with pytest.raises(errors.DatasetError, match="two cameras are named 'left'"):
        reading.read_calibration(tmp_path)


def test_files_without_a_calibrated_camera_are_refused(tmp_path):
    (tmp_path / "calibration.toml").write_text("[metadata]\nerror = 1.0\n")
    with pytest.raises(errors.DatasetError, match="expected calibrated cameras, found none"):
        reading.read_calibration(tmp_path)


def test_folders_without_a_calibration_are_refused_with_the_known_formats(tmp_path):
    assert reading.find_calibration(tmp_path) is None
    with pytest.raises(errors.DatasetError, match=r"camera_array\.toml \(caliscope\)"):
        reading.read_calibration(tmp_path)
    with pytest.raises(errors.DatasetError, match="does not exist"):
        reading.read_calibration(tmp_path / "nothing")

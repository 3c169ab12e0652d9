"""Qualisys' files against the formulas of their fields and OpenCV."""

import cv2
import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from tests.support.projections import BOUND, POINTS, pixels, rotation

AXES = [rotation(seed) for seed in (1, 2)]  # rows: right, up, backwards in the world
CENTERS = [np.array([100.0, -300.0, 2500.0]), np.array([-250.0, 120.0, 2200.0])]  # mm
LENS = {
    "focalLengthU": 64 * 700.5,
    "focalLengthV": 64 * 701.5,
    "centerPointU": 64 * 400.25,
    "centerPointV": 64 * 330.75,
}
DISTORTION = (-0.046, 0.14, 6e-4, 7e-4, 0.0)


def text(**changes: str) -> str:
    cameras = ""
    for k, (axes, center) in enumerate(zip(AXES, CENTERS, strict=True)):
        turn = " ".join(f'r{i + 1}{j + 1}="{axes[i, j]!r}"' for i in range(3) for j in range(3)).replace(
            "np.float64", ""
        )
        turn = turn.replace("(", "").replace(")", "")
        place = " ".join(f'{name}="{value}"' for name, value in zip("xyz", center, strict=True))
        lens = " ".join(f'{name}="{value}"' for name, value in LENS.items())
        more = dict(zip(("radialDistortion1", "radialDistortion2"), DISTORTION[:2], strict=True))
        more |= dict(zip(("tangentalDistortion1", "tangentalDistortion2"), DISTORTION[2:4], strict=True))
        lens += "".join(f' {name}="{value}"' for name, value in more.items())
        cameras += (
            f'<camera active="1" serial="2{k}" viewrotation="0">'
            f'<fov_video left="10" top="20" right="649" bottom="499"/>'
            f"<transform {turn} {place}/><intrinsic {lens}/></camera>"
        )
    result = f'<?xml version="1.0"?><calibration><cameras>{cameras}</cameras></calibration>'
    for old, new in changes.values():
        assert old in result
        result = result.replace(old, new)
    return result


def test_cameras_project_as_opencv(tmp_path):
    (tmp_path / "Calib.qca.txt").write_text(text())
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.meters_per_unit, calibration.names) == ("qualisys", 1e-3, ("20", "21"))
    points = 1000 * POINTS
    for camera, axes, center in zip(calibration.cameras, AXES, CENTERS, strict=True):
        matrix = np.array([[700.5, 0, 390.25], [0, 701.5, 310.75], [0, 0, 1]])  # of the video's part of the sensor
        p_cam = (points - center) @ axes.T * [1, -1, -1]
        expected = cv2.projectPoints(p_cam, np.zeros(3), np.zeros(3), matrix, np.array(DISTORTION))[0][:, 0] + 0.5
        assert (p_cam[:, 2] > 0).all()
        assert np.abs(pixels(camera.lens, camera.camera_to_world, points) - expected).max() < BOUND
        assert (camera.width, camera.height) == (640, 480)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('viewrotation="0"', 'viewrotation="90"', "camera 20: expected a view without rotation, found 90 degrees"),
        ("<intrinsic", "<other", "'intrinsic' is missing"),
        ('x="100.0"', 'x="far"', "'x': expected a finite number"),
        ('serial="21"', 'serial="20"', "two cameras are named '20'"),
        ("</cameras>", "", "not valid XML"),
        ('active="1"', 'active="0"', "expected calibrated cameras, found none"),
        ("<calibration>", "<!DOCTYPE x><calibration>", "without a document type"),
    ],
)
def test_damaged_files_are_refused(tmp_path, old, new, message):
    (tmp_path / "a.qca.txt").write_text(text(change=(old, new)))
    with pytest.raises(errors.DatasetError, match=message):
        reading.read_calibration(tmp_path)

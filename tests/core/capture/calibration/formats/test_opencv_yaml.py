"""OpenCV's YAML files, written by OpenCV itself."""

import cv2
import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from r5dgs_core.capture.calibration.formats import opencv_yaml
from tests.support.projections import BOUND, POINTS, pixels

MATRIX = np.array([[905.25, 0, 640.5], [0, 903.75, 361.25], [0, 0, 1]])
TURNS = {"01": (0.2, -0.3, 0.1), "Camera_B5": (2.2, 1.9, -0.4)}
SHIFT = np.array([[0.1], [-0.2], [3.0]])


def write(folder, coefficients, *, sizes=True, vectors=True, key="D"):
    inner = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    outer = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for storage in (inner, outer):
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in TURNS:
            storage.write("", name)
        storage.endWriteStruct()
    for name, turn in TURNS.items():
        inner.write(f"K_{name}", MATRIX)
        inner.write(f"{key}_{name}", np.array(coefficients, np.float64).reshape(-1, 1))
        if sizes:
            inner.write(f"W_{name}", 1280.0)
            inner.write(f"H_{name}", 720)
        if vectors:
            outer.write(f"R_{name}", np.array(turn).reshape(3, 1))
        outer.write(f"Rot_{name}", cv2.Rodrigues(np.array(turn))[0])
        outer.write(f"T_{name}", SHIFT)
    inner.release()
    outer.release()


@pytest.mark.parametrize(
    "coefficients, options",
    [
        ((-0.3, 0.1, 1e-3, -2e-3, 0.02), {}),
        ((-0.3, 0.1, 1e-3, -2e-3), {"key": "dist", "sizes": False, "vectors": False}),
        ((-0.3, 0.1, 1e-3, -2e-3, 0.02, 0.01, 0.02, -0.01), {}),
        ((-0.3, 0.1, 1e-3, -2e-3, 0.02, 0.01, 0.02, -0.01, 1e-3, -1e-3, 2e-3, 1e-3), {}),
    ],
)
def test_cameras_project_as_opencv(tmp_path, coefficients, options):
    write(tmp_path, coefficients, **options)
    calibration = reading.read_calibration(tmp_path)
    assert calibration.names == tuple(TURNS)
    for camera, turn in zip(calibration.cameras, TURNS.values(), strict=True):
        expected = cv2.projectPoints(POINTS, np.array(turn), SHIFT, MATRIX, np.array(coefficients))[0][:, 0] + 0.5
        assert np.abs(pixels(camera.lens, camera.camera_to_world) - expected).max() < BOUND
        assert (camera.width, camera.height) == ((1280, 720) if options.get("sizes", True) else (0, 0))


def test_the_file_of_the_extrinsics_leads_to_both(tmp_path):
    write(tmp_path, [0.0] * 5)
    calibration = reading.read_calibration(tmp_path / "extri.yml")
    assert calibration.format == "opencv_yaml" and calibration.cameras[0].lens.is_pinhole


def test_lists_and_texts_are_read(tmp_path):
    path = tmp_path / "a.yml"
    path.write_text(
        '%YAML:1.0\n---\nnames: [ "00", b1, "a-b" ]\nscale: -1.5e-01\nkind: "x"\nflow:\n   - "0"\n   - last\n'
    )
    assert opencv_yaml.read_storage(path) == {
        "names": ["00", "b1", "a-b"],
        "scale": -0.15,
        "kind": "x",
        "flow": ["0", "last"],
    }


@pytest.mark.parametrize(
    "file, old, new, message",
    [
        ("intri.yml", "%YAML", "", "which begins with '%YAML'"),
        ("intri.yml", "rows: 3", "rows: 4", "K_01: expected 4x3 numbers, found 9"),
        ("intri.yml", "640.5", "x", "K_01: expected a number, found 'x'"),
        ("intri.yml", "K_01", "Q_01", "camera 01: 'K_01' is missing"),
        ("extri.yml", "T_Camera_B5", "U_Camera_B5", "extri.yml: camera Camera_B5: 'T_Camera_B5' is missing"),
        ("intri.yml", "D_01", "rdist_01", "the lens model 'rdist' is not supported"),
    ],
)
def test_damaged_files_are_refused(tmp_path, file, old, new, message):
    write(tmp_path, [-0.3, 0.1, 0.0, 0.0, 0.0])
    content = (tmp_path / file).read_text()
    assert old in content
    (tmp_path / file).write_text(content.replace(old, new, 1))
    with pytest.raises(errors.DatasetError, match=message):
        reading.read_calibration(tmp_path)

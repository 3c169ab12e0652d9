"""The file of reconstructed cameras."""

from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from r5dgs_core.capture.calibration.calibration import CalibratedCamera, CalibratedFrame, Calibration
from r5dgs_core.capture.calibration.formats import r5dgs_json
from r5dgs_core.capture.calibration.lens import Lens
from tests.support.projections import rotation

LENS = Lens("brown", 300.25, 301.5, 160.0, 120.0, (-0.1, 0.01, 1e-3, 0.0), 0.5)


def pose(seed: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(seed), (seed, 0.5, -2.0)
    return matrix


def calibration() -> Calibration:
    frames = tuple(CalibratedFrame(Path(f"{k:06d}.png"), k / 3, LENS, pose(k)) for k in range(3))
    cameras = CalibratedCamera("a", 320, 240, LENS, pose(5)), CalibratedCamera("b", 320, 240, LENS, pose(0), frames)
    points, colors = np.arange(12.0).reshape(4, 3) / 7, np.full((4, 3), 0.25, np.float32)
    return Calibration(cameras, 0.25, "features", Path(), "blender", points=points, colors=colors)


def test_written_cameras_are_read_again(tmp_path):
    path = tmp_path / "r5dgs_cameras.json"
    r5dgs_json.write(path, calibration())
    found = reading.read_calibration(tmp_path)
    assert (found.format, found.meters_per_unit, found.world_convention) == ("r5dgs_json", 0.25, "blender")
    np.testing.assert_allclose(found.points, calibration().points, atol=1e-6)
    np.testing.assert_array_equal(found.colors, calibration().colors)
    for new, old in zip(found.cameras, calibration().cameras, strict=True):
        assert (new.name, new.width, new.height, new.lens) == (old.name, old.width, old.height, old.lens)
        np.testing.assert_allclose(new.camera_to_world, old.camera_to_world, atol=1e-12)
        for a, b in zip(new.frames, old.frames, strict=True):
            assert (a.path, a.time, a.lens) == (b.path, b.time, b.lens)
            np.testing.assert_allclose(a.camera_to_world, b.camera_to_world, atol=1e-12)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('"format_version": 1', '"format_version": 2', "expected format_version 1"),
        ('"blender"', '"north"', "'world_convention'"),
        ('"brown"', '"barrel"', "unknown lens model 'barrel'"),
        ('"name": "b"', '"name": "A"', "two cameras are named"),
        ('"points": [\n  [', '"points": [\n  [1, ', "'points': expected"),
        ('"fx": 300.25', '"fx": "wide"', "'fx': expected a finite number"),
    ],
)
def test_damaged_files_are_refused(tmp_path, old, new, message):
    path = tmp_path / "r5dgs_cameras.json"
    r5dgs_json.write(path, calibration())
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(errors.DatasetError, match=message):
        reading.read_calibration(path)

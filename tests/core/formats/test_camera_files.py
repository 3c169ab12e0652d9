"""Camera files are read back by the readers of data sets as the cameras that were written."""

import json

import numpy as np
import pytest

from r5dgs_core.data import colmap_model, transforms
from r5dgs_core.formats import camera_files
from r5dgs_core.formats.camera_files import CameraFrame
from r5dgs_core.scene import cameras
from tests.support.scenes import orbit_camera


def views(widths=(96, 96, 96)):
    return [
        CameraFrame(f"images/view {k}.png", orbit_camera(0.4 * k, width), 0.25 * k) for k, width in enumerate(widths)
    ]


@pytest.mark.parametrize("widths", [(96, 96, 96), (96, 64, 128)])
def test_transforms_are_read_back(tmp_path, widths):
    written = views(widths)
    entries, rest = transforms.read(camera_files.write_transforms(tmp_path / "transforms.json", written))
    assert ("camera_angle_x" in rest) == (len(set(widths)) == 1)
    for view, entry in zip(written, entries, strict=True):
        camera = view.camera
        assert (entry.file_path, entry.t) == (view.file_path, view.t)
        np.testing.assert_allclose(cameras.opengl_to_cam_world(entry.matrix), camera.T_cam_world, atol=1e-12)
        np.testing.assert_allclose(
            transforms.intrinsics(entry, camera.width, camera.height), camera.intrinsics, atol=1e-9
        )


def test_without_times_no_time_is_written(tmp_path):
    still = [CameraFrame(view.file_path, view.camera) for view in views()]
    path = camera_files.write_transforms(tmp_path / "transforms.json", still)
    assert all("time" not in frame for frame in json.loads(path.read_text())["frames"])
    camera_files.write_colmap(tmp_path, still)
    assert not (tmp_path / "times.json").exists()


def test_colmap_text_is_read_back(tmp_path):
    written = views((96, 64, 96))
    model = colmap_model.read(camera_files.write_colmap(tmp_path, written))
    assert len(model.points) == 0
    by_name = {image.name: image for image in model.images}
    for view in written:
        found, camera = by_name[view.file_path.removeprefix("images/")], view.camera
        np.testing.assert_allclose(found.T_cam_world, camera.T_cam_world, atol=1e-12)
        assert (found.lens.width, found.lens.height) == (camera.width, camera.height)
        k = camera.intrinsics
        assert (found.lens.fx, found.lens.fy, found.lens.cx, found.lens.cy) == pytest.approx(
            (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        )
    times = json.loads((tmp_path / "times.json").read_text())["times"]
    assert times == {view.file_path.removeprefix("images/"): view.t for view in written}

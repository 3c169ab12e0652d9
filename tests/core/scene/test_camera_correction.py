"""Corrections of cameras: identity, colours and their inverse, JSON, and sizes in words."""

import numpy as np
import pytest

from r5dgs_core.scene import camera_correction, cameras
from r5dgs_core.scene.camera_correction import COUNT, Correction
from tests.support import tiny_datasets

CAMERA = tiny_datasets.orbit_camera(0.3, 48, 36)
CHANGE = np.random.default_rng(2).normal(0, 0.05, COUNT)


def test_no_correction_changes_nothing():
    image = np.random.default_rng(0).uniform(size=(4, 5, 3))
    same = Correction().camera(CAMERA)
    np.testing.assert_array_equal(same.T_cam_world, CAMERA.T_cam_world)
    np.testing.assert_array_equal(same.intrinsics, CAMERA.intrinsics)
    np.testing.assert_array_equal(Correction().seen(image), image)
    assert not Correction().changes_colors


def test_a_corrected_camera_moves_points_in_its_own_axes():
    correction = Correction(rotvec=np.array([0, 0, np.pi / 2]), shift=np.array([0.1, 0, 0]), log_focal=np.log(2))
    point = np.array([[0.3, 0.2, 0.4]])
    x, y, z = (CAMERA.T_cam_world[:3, :3] @ point[0]) + CAMERA.T_cam_world[:3, 3]
    focal, center = CAMERA.intrinsics[0, 0], CAMERA.intrinsics[:2, 2]
    pixels, _ = cameras.project(correction.camera(CAMERA), point)
    np.testing.assert_allclose(pixels[0], 2 * focal * np.array([-y + 0.1, x]) / z + center, rtol=1e-9)


def test_colours_seen_by_a_camera_are_undone():
    correction = Correction().plus(CHANGE)
    image = np.random.default_rng(1).uniform(size=(3, 4, 3)).astype(np.float32)
    assert correction.changes_colors
    np.testing.assert_allclose(correction.unseen(correction.seen(image)), image, atol=1e-6)


def test_a_correction_survives_json():
    correction = Correction().plus(CHANGE)
    again = camera_correction.from_dict(correction.to_dict())
    assert again.to_dict() == correction.to_dict()


def test_the_shift_is_converted_to_another_unit():
    correction = Correction().plus(CHANGE).scaled(3.0)
    np.testing.assert_allclose(correction.shift, 3 * CHANGE[3:6])
    np.testing.assert_allclose(correction.rotvec, CHANGE[:3])


def test_sizes_name_refined_parts_only():
    corrections = {"a": Correction(time=0.01).to_dict(), "b": Correction(time=-0.03).to_dict()}
    record = {"refined": ["time_offsets"], "corrections": corrections, "pixels": {"a": 0.0, "b": 0.0}}
    assert camera_correction.sizes(record) == {
        "time_offsets": "clocks moved by 0.02 (at most 0.03) units of scene time"
    }
    timed = camera_correction.sizes({**record, "seconds_per_unit": 2.0})
    assert timed["time_offsets"] == "clocks moved by 40 (at most 60) ms"
    assert camera_correction.sizes({}) == {}


@pytest.mark.parametrize("name", ["rotvec", "time"])
def test_an_incomplete_record_is_an_error(name):
    values = Correction().to_dict()
    del values[name]
    with pytest.raises(KeyError, match=name):
        camera_correction.from_dict(values)

"""Camera paths."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.film import camera_path
from r5dgs_core.scene import cameras
from tests.support import scenes


def test_an_orbit_keeps_distance_and_height_and_returns(scene):
    first = scene.cameras[0]
    path = camera_path.orbit(scene)
    found = path.cameras(8)
    np.testing.assert_allclose(found[0].T_cam_world, first.T_cam_world, atol=1e-12)
    middle = np.median(scene.gaussians.means[scene.gaussians.object_ids > 0].astype(float), 0)
    centers = np.array([camera.center for camera in found])
    np.testing.assert_allclose(centers[:, 2], first.center[2])
    radii = np.linalg.norm((centers - middle)[:, :2], axis=1)
    np.testing.assert_allclose(radii, radii[0])
    np.testing.assert_allclose(centers[0] + centers[4], centers[2] + centers[6], atol=1e-9)
    for camera in found:
        cameras.check(camera)


def test_a_curve_passes_through_its_cameras_without_jumps():
    keys = [scenes.orbit_camera(angle) for angle in (0.0, 0.5, 2.0, 3.5)]
    found = camera_path.curve(keys).cameras(400)
    centers = np.array([camera.center for camera in found])
    for key in keys:
        assert np.linalg.norm(centers - key.center, axis=1).min() < 0.03
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 2.5 * np.median(steps)
    turns = [
        np.linalg.norm(a.T_cam_world[:3, :3] - b.T_cam_world[:3, :3]) for a, b in zip(found, found[1:], strict=False)
    ]
    assert max(turns) < 0.05
    for camera in found[::50]:
        cameras.check(camera)


def test_equal_cameras_are_a_path_that_stands_still():
    key = scenes.orbit_camera(0.3)
    for camera in camera_path.curve([key, key]).cameras(3):
        np.testing.assert_allclose(camera.T_cam_world, key.T_cam_world, atol=1e-9)


def test_lines_are_exact_with_as_many_frames_as_cameras():
    keys = [scenes.orbit_camera(angle) for angle in (0.0, 0.5, 4.0)]
    path = camera_path.lines(keys, None, 30.0)
    for found, key in zip(path.cameras(path.count), keys, strict=True):
        np.testing.assert_allclose(found.T_cam_world, key.T_cam_world, atol=1e-12)
        np.testing.assert_allclose(found.intrinsics, key.intrinsics, atol=1e-12)


@pytest.mark.parametrize("size", [(96, 72), (200, 72), (48, 90), (191, 143)])
def test_a_camera_of_another_size_shows_all_that_it_showed(size):
    camera = scenes.orbit_camera(0.3)
    found = camera_path.fitted(camera, *size)
    assert (found.width, found.height) == size
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    rays = np.concatenate([corners, np.ones((4, 1))], 1) @ np.linalg.inv(camera.intrinsics).T
    places = (rays @ found.intrinsics.T)[:, :2]
    assert (places >= -1.0).all() and (places <= np.array(size) + 1.0).all()
    scale = found.intrinsics[0, 0] / camera.intrinsics[0, 0]
    assert scale == pytest.approx(min(size[0] / camera.width, size[1] / camera.height), abs=0.01)


def test_cameras_of_several_sizes_give_pictures_of_the_first_ones_size():
    keys = [scenes.orbit_camera(0.0), dataclasses.replace(scenes.orbit_camera(1.0), width=50)]
    assert {(camera.width, camera.height) for camera in camera_path.curve(keys).cameras(5)} == {(96, 72)}

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.scene import cameras
from tests import scenes


@pytest.fixture
def camera():
    return scenes.orbit_camera(0.7, 160, 90)


def test_conversion_to_opengl_and_back_is_exact():
    matrix = np.eye(4)
    matrix[:3, :3] = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array([0.3, -1.0, 2.0])))
    matrix[:3, 3] = [1, 2, 3]
    np.testing.assert_allclose(cameras.cam_world_to_opengl(cameras.opengl_to_cam_world(matrix)), matrix, atol=1e-14)
    scaled = matrix.copy()
    scaled[:3, :3] *= 2.5
    np.testing.assert_allclose(cameras.opengl_to_cam_world(scaled), cameras.opengl_to_cam_world(matrix), atol=1e-14)


def test_an_opengl_camera_looks_along_minus_z_with_y_up():
    camera = scenes.camera_from_field_of_view(np.eye(4), np.pi / 2, 100, 60)
    np.testing.assert_allclose(camera.forward, [0, 0, -1])
    np.testing.assert_allclose(camera.center, [0, 0, 0])
    # 90 degrees across 100 pixels: a point one to the right at depth one lies on the right edge; up is a smaller row.
    pixels, depth = cameras.project(camera, np.array([[1.0, 0, -1], [0, 0.2, -1], [0, 0, -3], [0, 0, 1]]))
    np.testing.assert_allclose(pixels[0], [100, 30])
    np.testing.assert_allclose(pixels[1], [50, 20])
    np.testing.assert_allclose(pixels[2], [50, 30])
    np.testing.assert_allclose(depth, [1, 1, 3, -1])
    assert np.isnan(pixels[3]).all()


def test_rays_go_through_their_pixel_centres(camera):
    rays = cameras.pixel_rays(camera)
    assert rays.shape == (90, 160, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1)
    pixels, _ = cameras.project(camera, camera.center + 3.3 * rays[40, 77])
    np.testing.assert_allclose(pixels, [77.5, 40.5], atol=1e-9)


def test_rays_follow_skewed_intrinsics(camera):
    skewed = np.array([[120.0, 7, 70], [0, 110, 50], [0, 0, 1]])
    other = cameras.Camera(camera.width, camera.height, skewed, camera.T_cam_world)
    pixels, _ = cameras.project(other, other.center + 2.0 * cameras.pixel_rays(other)[11, 5])
    np.testing.assert_allclose(pixels, [5.5, 11.5], atol=1e-9)


def test_centre_and_forward_agree_with_the_projection(camera):
    pixels, depth = cameras.project(camera, camera.center + 2 * camera.forward)
    np.testing.assert_allclose(pixels, [80, 45], atol=1e-9)
    assert depth == pytest.approx(2)


@pytest.mark.parametrize("name", cameras.WORLD_TO_BLENDER)
def test_world_conventions_are_rotations(name):
    matrix = cameras.WORLD_TO_BLENDER[name]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3))
    assert np.linalg.det(matrix) == pytest.approx(1)


def test_up_becomes_z_in_blender():
    np.testing.assert_array_equal(cameras.WORLD_TO_BLENDER["colmap"] @ [0, -1, 0], [0, 0, 1])
    np.testing.assert_array_equal(cameras.WORLD_TO_BLENDER["opengl"] @ [0, 1, 0], [0, 0, 1])

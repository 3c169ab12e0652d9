import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.scene import cameras
from tests.support import scenes


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


def perspective_projection(camera):
    """The OpenGL projection of a camera without skew."""
    k, (w, h) = camera.intrinsics, (camera.width, camera.height)
    p = np.zeros((4, 4))
    p[0, 0], p[0, 2] = 2 * k[0, 0] / w, 1 - 2 * k[0, 2] / w
    p[1, 1], p[1, 2] = 2 * k[1, 1] / h, 2 * k[1, 2] / h - 1
    p[2, 2], p[2, 3], p[3, 2] = -1.002, -0.2, -1.0
    return p


def test_a_perspective_projection_gives_back_its_camera(camera):
    shifted = cameras.crop(camera, 13, -7, 100, 60)
    world = cameras.cam_world_to_opengl(shifted.T_cam_world)
    found, away = cameras.from_projection(perspective_projection(shifted), world, 100, 60, name=shifted.name)
    assert away == 0 and (found.width, found.height) == (100, 60)
    np.testing.assert_allclose(found.intrinsics, shifted.intrinsics, atol=1e-9)
    np.testing.assert_allclose(found.T_cam_world, shifted.T_cam_world, atol=1e-12)


@pytest.mark.parametrize("depths", [(2.0, 5.0), (-3.0, 4.0), (1e3, 1e3 + 1)])
def test_a_parallel_projection_is_approximated_from_very_far_away(camera, depths):
    world = cameras.cam_world_to_opengl(camera.T_cam_world)
    projection = np.diag([0.5, 0.8, -0.01, 1.0])
    projection[:2, 3] = 0.1, -0.3
    found, away = cameras.from_projection(projection, world, 800, 600, depths)
    rng = np.random.default_rng(0)
    local = rng.uniform([-2, -1.25, -depths[1]], [2, 1.25, -depths[0]], (200, 3))  # OpenGL camera axes
    clip = local @ projection[:3, :3].T + projection[:3, 3]
    expected = np.stack([400 * (1 + clip[:, 0]), 300 * (1 - clip[:, 1])], -1)
    pixels, depth = cameras.project(found, local @ world[:3, :3].T + world[:3, 3])
    assert np.abs(pixels - expected).max() < 0.1
    np.testing.assert_allclose(depth - away, -local[:, 2], atol=1e-6 * max(map(abs, depths)))


def test_cropped_and_resized_cameras_keep_their_rays(camera):
    part, small = cameras.crop(camera, 20, 10, 50, 30), cameras.resize(camera, 80, 30)
    np.testing.assert_allclose(cameras.pixel_rays(part), cameras.pixel_rays(camera)[10:40, 20:70], atol=1e-12)
    points = camera.center + 3 * cameras.pixel_rays(camera)[::7, ::9].reshape(-1, 3)
    one, _ = cameras.project(camera, points)
    other, _ = cameras.project(small, points)
    np.testing.assert_allclose(other, one * [80 / 160, 30 / 90], atol=1e-9)


def test_a_moved_camera_shows_a_moved_world(camera):
    shift, points = np.array([3.0, -1.0, 0.5]), camera.center + cameras.pixel_rays(camera)[::30, ::40].reshape(-1, 3)
    for found, expected in zip(
        cameras.project(cameras.translated(camera, shift), points + shift), cameras.project(camera, points), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert cameras.translated(camera, np.zeros(3)) is camera


def changed(matrix, at, value):
    matrix = matrix.copy()
    matrix[at] = value
    return matrix


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda c: {"width": 32.0}, TypeError, "whole numbers of pixels"),
        (lambda c: {"height": 0}, ValueError, "width and height of 1 to"),
        (lambda c: {"width": cameras.MAX_SIDE + 1}, ValueError, "width and height of 1 to"),
        (lambda c: {"intrinsics": c.intrinsics.tolist()}, TypeError, "intrinsics: expected an array"),
        (lambda c: {"T_cam_world": c.T_cam_world[:3]}, ValueError, r"T_cam_world: expected shape \(4, 4\)"),
        (lambda c: {"T_cam_world": changed(c.T_cam_world, (1, 3), np.nan)}, ValueError, r"nan at index \(1, 3\)"),
        (lambda c: {"T_cam_world": changed(c.T_cam_world, (0, 3), 1e300)}, ValueError, r"1e\+300 at index \(0, 3\)"),
        (lambda c: {"intrinsics": changed(c.intrinsics, (2, 2), 2.0)}, ValueError, "as the last row"),
        (lambda c: {"T_cam_world": c.T_cam_world @ np.diag([2.0, 2, 2, 1])}, ValueError, "expected a rotation"),
        (lambda c: {"T_cam_world": np.diag([1.0, 1, -1, 1])}, ValueError, "expected a rotation"),
        (lambda c: {"intrinsics": changed(c.intrinsics, (1, 0), 0.1)}, ValueError, r"expected 0 at index \(1, 0\)"),
        (lambda c: {"intrinsics": changed(c.intrinsics, (1, 1), 0.0)}, ValueError, "focal lengths above 0"),
    ],
)
def test_unusable_cameras_are_refused_by_the_name_of_the_entry(camera, change, error, message):
    cameras.check(camera)
    with pytest.raises(error, match=f"camera {camera.name!r}: .*{message}" if camera.name else message):
        cameras.check(dataclasses.replace(camera, **change(camera)))

"""Gaussians in front of meshes, and the depths of meshes."""

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from r5dgs_core.raster import RasterSettings
from r5dgs_core.render import front_layer, mesh_depths, posed_scene, scene_renderer
from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.scene.instance import Instance
from tests.support import scenes

pytest.importorskip("numba", reason="numba is not installed; the kernels need it")
SETTINGS = RasterSettings()
CAMERA = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(4))
TRIANGLE = np.array([[0, 1, 2]])


@pytest.fixture(scope="module")
def posed():
    scene = scenes.make_scene(n=500, objects=4, seed=3)
    return scene, posed_scene.pose_frame(scene, scene_player.Player(scene).frame(0.4))


def test_a_triangle_has_the_depths_of_its_plane():
    corners = np.array([[-3, -3, 4.0], [3, -3, 4.0], [0, 3, 8.0]])
    depths = mesh_depths.draw(CAMERA, corners, TRIANGLE, 0.1)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    x, y = np.meshgrid((np.arange(64) - 31.5) / 60, (np.arange(48) - 23.5) / 60)
    plane = corners[0] @ normal / (x * normal[0] + y * normal[1] + normal[2])
    inside = np.s_[5:30, 28:37]
    np.testing.assert_allclose(depths[inside], plane[inside], rtol=1e-4)


def test_the_nearest_surface_counts_and_outlines_are_widened():
    far, near = (np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]]) for z in (5.0, 3.0))
    quads = np.concatenate([far, 0.5 * near * [1, 1, 2]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    depths = mesh_depths.draw(CAMERA, quads, faces, 0.1)
    assert depths[24, 32] == pytest.approx(3) and depths[24, 43] == pytest.approx(5)
    edge = 32 + 60 // 5
    assert np.isfinite(depths[24, edge + 1]) and depths[24, edge + 3] == np.inf


def test_a_triangle_that_passes_the_camera_is_clipped_in_front_of_it():
    floor = np.array([[-50, 1, -50.0], [50, 1, -50.0], [0, 1, 200.0]])
    depths = mesh_depths.draw(CAMERA, floor, TRIANGLE, 0.1)
    np.testing.assert_allclose(depths[40, 32], 60 / 16.5, rtol=1e-4)
    assert np.isinf(depths[:20]).all()


def test_before_a_far_mesh_the_layer_is_the_whole_picture(posed):
    scene, pose = posed
    camera = scene.cameras[0]
    layer = front_layer.render(pose, camera, np.full((camera.height, camera.width), 1e6, np.float32), SETTINGS)
    picture = scene_renderer.render_frame(scene, pose, camera, background=None, settings=SETTINGS)
    np.testing.assert_allclose(layer[..., :3], picture.color, atol=0.01)
    np.testing.assert_allclose(layer[..., 3], picture.alpha, atol=0.02)  # the rasterizer stops at opaque pixels
    assert picture.alpha.max() > 0.9


def test_only_gaussians_nearer_than_the_mesh_are_in_the_layer(posed):
    scene, pose = posed
    camera = scene.cameras[0]
    z = (pose.means + pose.origin) @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    middle = float(np.median(z))
    plane = np.full((camera.height, camera.width), middle, np.float32)
    plane[:, : camera.width // 2] = np.inf
    layer = front_layer.render(pose, camera, plane, SETTINGS)
    only = front_layer.render(
        pose, camera, np.where(np.isfinite(plane), 1e6, np.inf).astype(np.float32), SETTINGS, z > middle
    )
    assert (layer[:, : camera.width // 2] == 0).all()
    assert layer[..., 3].mean() > 0.02 and np.abs(layer - only).mean() < 0.02


def test_a_gaussian_fades_where_a_surface_cuts_it():
    pose = one_gaussian(depth=4.0, scale=0.5)
    alphas = [
        front_layer.render(pose, CAMERA, np.full((48, 64), depth, np.float32), SETTINGS)[24, 32, 3]
        for depth in (3.0, 4.0, 5.0, 9.0)
    ]
    assert alphas[3] == pytest.approx(0.9, abs=0.01) and alphas[1] == pytest.approx(0.45, abs=0.01)
    assert alphas[0] == pytest.approx(0.9 * 0.0228, abs=2e-3) and alphas[2] == pytest.approx(0.9 * 0.9772, abs=0.01)


def one_gaussian(depth, scale):
    rows, one = np.zeros(1, np.int64), np.ones((1, 3), np.float32)
    return posed_scene.PosedScene(
        *(one * [0, 0, depth], np.array([[1, 0, 0, 0]], np.float32), np.log(scale) * one),
        *(np.array([np.log(9)], np.float32), np.zeros((1, 1, 3), np.float32), rows.astype(np.int32)),
        *(np.eye(3)[None], rows, None),
    )


def test_faint_background_gaussians_of_the_colour_of_the_sky_belong_to_it(posed):
    scene, pose = posed
    sky, count = spherical_harmonics.dc_to_rgb(scene.background_sh[0]), len(pose.means)
    pose = posed_scene.PosedScene(**{**vars(pose), "sh": pose.sh.copy(), "opacity_logits": pose.opacity_logits.copy()})
    background = np.flatnonzero(scene.gaussians.object_ids == 0)[:4]
    pose.sh[:], pose.opacity_logits[:] = 0, -2
    pose.sh[:, 0] = spherical_harmonics.rgb_to_dc(sky + 0.5)
    alike, other, opaque, object_ = *background[:3], int(np.flatnonzero(scene.gaussians.object_ids == 1)[0])
    for row in (alike, opaque, object_):
        pose.sh[row, 0] = spherical_harmonics.rgb_to_dc(sky + 0.02)
    pose.opacity_logits[opaque] = 4
    found = front_layer.sky_mask([scene], [Instance(0, count, np.eye(4))], pose, scene.cameras[0])
    assert found[alike] and not found[[other, opaque, object_]].any() and found.sum() == 1

"""The 3D views after loading a scene: from the captured camera that sees the objects best."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, scenes


def looking(eye, target, name):
    """A camera at a place that looks at another."""
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    rows = np.stack([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rows, -rows @ eye
    return cameras.Camera(100, 80, np.array([[90.0, 0, 50], [0, 90, 40], [0, 0, 1]]), T, name)


def spaces(bpy):
    return [
        area.spaces.active
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        if area.type == "VIEW_3D"
    ]


@pytest.mark.parametrize("convention", ["blender", "colmap"])
def test_views_look_from_the_camera_that_sees_the_objects_best(blender, tmp_path, convention):
    scene = scenes.make_scene(n=200, objects=2, world_convention=convention)
    middle = scene.gaussians.means[scene.gaussians.object_ids > 0].mean(0)
    eye = middle + np.array([4.0, -5.0, 2.0])
    best, away, aside = (looking(eye, middle + shift, "c") for shift in ((0, 0, 0), 2 * (eye - middle), (1.5, 0, 1)))
    path = scene_file.write(dataclasses.replace(scene, cameras=(away, aside, best)), tmp_path / "scene.r5dgs")
    collection = motions.load(blender, path)
    to_blender = np.eye(4)
    to_blender[:3, :3] = cameras.WORLD_TO_BLENDER[convention]
    (space,) = spaces(blender)
    view = space.region_3d
    seen_from = np.array(view.view_location) + view.view_distance * np.array(view.view_rotation.to_matrix())[:, 2]
    np.testing.assert_allclose(seen_from, to_blender[:3, :3] @ eye, atol=1e-4)
    np.testing.assert_allclose(
        np.array(view.view_rotation.to_matrix())[:, 2], -to_blender[:3, :3] @ best.forward, atol=1e-5
    )
    assert space.clip_start <= 0.01 and space.clip_end >= 1000
    view.view_distance *= 3
    blender.ops.r5dgs.set_display(display="POINTS")
    assert blender.ops.r5dgs.view_as_trained() == {"FINISHED"}
    assert collection.r5dgs.display == "SPLATS"
    again = np.array(view.view_location) + view.view_distance * np.array(view.view_rotation.to_matrix())[:, 2]
    np.testing.assert_allclose(again, seen_from, atol=1e-4)


@pytest.mark.parametrize("size", [(100, 80), (80, 300)])
def test_the_picture_of_the_camera_fits_into_the_view(blender, tmp_path, size):
    scene = scenes.make_scene(n=200, objects=2)
    camera = looking(np.array([4.0, -5.0, 2.0]), np.zeros(3), "c")
    camera = dataclasses.replace(camera, width=size[0], height=size[1])
    motions.load(blender, scene_file.write(dataclasses.replace(scene, cameras=(camera,)), tmp_path / "scene.r5dgs"))
    (space,) = spaces(blender)
    (area,) = (area for area in blender.context.window.screen.areas if area.type == "VIEW_3D")
    region = next(one for one in area.regions if one.type == "WINDOW")
    pixels = space.lens / 72 * max(region.width, region.height)  # focal length; see Blender's `CAMERA_PARAM_ZOOM_INIT`
    shown = pixels * np.array(size) / 90 / (region.width, region.height)
    assert shown.max() == pytest.approx(1, abs=1e-4) and region.width > 1


def test_a_view_through_a_camera_and_the_users_choice_are_respected(blender, tmp_path):
    path = scene_file.write(scenes.make_scene(n=200), tmp_path / "scene.r5dgs")
    (space,) = spaces(blender)
    before = space.region_3d.view_matrix.copy()
    motions.load(blender, path, frame_views=False)
    assert space.region_3d.view_matrix == before
    space.region_3d.view_perspective = "CAMERA"
    location = space.region_3d.view_location.copy()
    blender.ops.r5dgs.view_as_trained()
    assert space.region_3d.view_location == location and space.region_3d.view_perspective == "CAMERA"


def test_a_scene_without_cameras_is_loaded_without_a_change_of_view(blender, tmp_path):
    scene = dataclasses.replace(scenes.make_scene(n=200), cameras=())
    (space,) = spaces(blender)
    before = space.region_3d.view_location.copy()
    motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    assert space.region_3d.view_location == before
    assert blender.ops.r5dgs.view_as_trained() == {"FINISHED"}


@pytest.mark.parametrize("scale", [(-1, 1, 1), (2, 0.5, 3), (-0.1, -5, 1), (1, 1, -1)])
def test_a_mirrored_or_stretched_root_is_seen_from_where_the_camera_is(blender, tmp_path, scale):
    scene = scenes.make_scene(n=200, objects=2)
    eye, middle = np.array([4.0, -5.0, 2.0]), scene.gaussians.means[scene.gaussians.object_ids > 0].mean(0)
    scene = dataclasses.replace(scene, cameras=(looking(eye, middle, "c"),))
    collection = motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    root, (space,) = collection.r5dgs.root, spaces(blender)
    root.scale, root.location, root.rotation_quaternion = scale, (1, 2, 3), (0.8, 0.1, 0.5, 0.3)
    blender.context.view_layer.update()
    assert blender.ops.r5dgs.view_as_trained() == {"FINISHED"}
    moved, axes = np.array(root.matrix_world), np.array(space.region_3d.view_rotation.to_matrix())
    seen_from = np.array(space.region_3d.view_location) + space.region_3d.view_distance * axes[:, 2]
    np.testing.assert_allclose(seen_from, moved[:3, :3] @ eye + moved[:3, 3], atol=1e-4)
    ahead = moved[:3, :3] @ (middle - eye)
    np.testing.assert_allclose(-axes[:, 2], ahead / np.linalg.norm(ahead), atol=1e-4)
    assert axes[:, 1] @ moved[:3, :3] @ -scene.cameras[0].T_cam_world[1, :3] > 0  # not upside down


def test_a_root_without_size_changes_no_view(blender, tmp_path):
    collection = motions.load(blender, scene_file.write(scenes.make_scene(n=200), tmp_path / "scene.r5dgs"))
    (space,) = spaces(blender)
    before = space.region_3d.view_location.copy()
    for scale in (0.0, float("nan")):
        collection.r5dgs.root.scale = (scale,) * 3
        blender.context.view_layer.update()
        assert blender.ops.r5dgs.view_as_trained() == {"FINISHED"}
        assert space.region_3d.view_location == before

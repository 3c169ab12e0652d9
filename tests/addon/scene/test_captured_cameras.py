"""Captured cameras of a loaded scene as Blender cameras."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core.formats import image_files
from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, scenes


@pytest.fixture
def captured():
    """Three cameras with other lenses, sizes and principal points; the second sees the objects best."""
    made = scenes.make_scene(n=200, objects=2)
    base = scenes.orbit_camera(0.3, 96, 72)
    away = np.diag([-1.0, 1, -1, 1]) @ base.T_cam_world
    k = np.array([[110.0, 0, 45], [0, 110.0, 40], [0, 0, 1]])
    found = (
        dataclasses.replace(base, T_cam_world=away, name="away"),
        dataclasses.replace(base, intrinsics=k, name=""),
        cameras.Camera(60, 90, np.array([[70.0, 0, 30], [0, 70.0, 45], [0, 0, 1]]), away, "upright"),
    )
    return dataclasses.replace(made, cameras=found)


@pytest.mark.parametrize("convention", ["blender", "colmap"])
def test_blender_sees_what_the_cameras_saw(blender, captured, tmp_path, convention):
    captured = dataclasses.replace(captured, world_convention=convention)
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"))
    home = collection.children["Cameras"]
    assert {one.name for one in home.objects} == {"away", "camera 2", "upright"}
    assert not any(camera.visible_get() for camera in home.objects)
    module, view_cameras = motions.addon("scene.captured_cameras"), motions.addon("engine.view_cameras")
    world = np.eye(4)
    world[:3, :3] = cameras.WORLD_TO_BLENDER[convention]
    for name, camera in zip(("away", "camera 2", "upright"), captured.cameras, strict=True):
        assert blender.ops.r5dgs.use_captured_camera(camera=name) == {"FINISHED"}
        assert module.name_of(home.objects[name]) == camera.name or not camera.name
        blender.context.view_layer.update()
        seen = view_cameras.of_camera(blender.context.evaluated_depsgraph_get(), lambda: np.zeros((0, 3))).camera
        assert (seen.width, seen.height) == (camera.width, camera.height)
        np.testing.assert_allclose(seen.intrinsics, camera.intrinsics, atol=1e-3)
        np.testing.assert_allclose(seen.T_cam_world @ world, camera.T_cam_world, atol=1e-5)


def test_the_best_camera_is_used_unless_the_file_uses_one_of_its_own(blender, captured, tmp_path):
    path, scene = scene_file.write(captured, tmp_path / "scene.r5dgs"), blender.context.scene
    motions.load(blender, path)
    assert scene.camera.name == "camera 2" and (scene.render.resolution_x, scene.render.resolution_y) == (96, 72)
    blender.ops.wm.read_homefile(app_template="")
    scene = blender.context.scene
    scene.camera.location.x += 1
    own, size = scene.camera, scene.render.resolution_x
    motions.load(blender, path)
    assert scene.camera == own and scene.render.resolution_x == size


def test_cameras_are_left_out_on_demand(blender, captured, tmp_path):
    before = len(blender.data.cameras)
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"), cameras=False)
    assert "Cameras" not in collection.children and len(blender.data.cameras) == before


def png(path, value):
    """An image of one pixel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return image_files.write_png(path, np.full((1, 1), value, np.uint8))


def shown(home):
    """File names of the background images by camera."""
    return {
        camera.name: [Path(one.image.filepath).name for one in camera.data.background_images]
        for camera in home.objects
        if camera.data.show_background_images
    }


def test_images_of_the_current_time_are_backgrounds_of_their_cameras(blender, captured, tmp_path):
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"))
    folder, home = tmp_path / "data", collection.children["Cameras"]
    frames = []
    for number, (view, t) in enumerate((("away", 0.0), ("away", 0.4), ("upright", 0.4))):
        png(folder / "train" / f"r_{number}.png", number)
        frames.append({"file_path": f"./train/r_{number}", "time": t, "view": view})
    frames.append({"file_path": "../../secret", "time": 0.4, "view": "camera 2"})
    png(tmp_path.parent / "secret.png", 9)
    (folder / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    motions.go_to(blender, collection, 0.5)
    assert blender.ops.r5dgs.show_captured_images(directory=str(folder)) == {"FINISHED"}
    assert shown(home) == {"away": ["r_1.png"], "upright": ["r_2.png"]}
    motions.go_to(blender, collection, 0.0)
    assert shown(home) == {"away": ["r_0.png"], "upright": ["r_2.png"]}


def test_images_of_a_file_that_lists_them_by_camera_have_its_times(blender, captured, tmp_path):
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"))
    folder, home = tmp_path / "data", collection.children["Cameras"]
    for number in range(3):
        png(folder / "images" / "away" / f"{number:04d}.png", number)
    for split, numbers in (("train", (0, 1)), ("test", (2,))):
        frames = [{"file_path": f"images/away/{k:04d}.png", "time": scenes.T_MAX * (0.0, 1.0, 1.2)[k]} for k in numbers]
        path = folder / f"transforms_{split}.json"
        path.write_text(json.dumps({"data": {"away": {"fl_x": 50.0, "frames": frames}}}))
    motions.go_to(blender, collection, scenes.T_MAX)
    assert blender.ops.r5dgs.show_captured_images(directory=str(folder)) == {"FINISHED"}
    assert shown(home) == {"away": ["0001.png"]}
    motions.go_to(blender, collection, 1.2 * scenes.T_MAX)
    assert shown(home) == {"away": ["0002.png"]}


def test_images_follow_the_frame_after_undo_and_in_a_reopened_file(blender, captured, tmp_path):
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"))
    folder, name = tmp_path / "data", collection.name
    for number in range(3):
        png(folder / "away" / f"{number:04d}.png", number)
    blender.ops.ed.undo_push(message="loaded")
    assert blender.ops.r5dgs.show_captured_images(directory=str(folder)) == {"FINISHED"}
    blender.ops.ed.undo_push(message="shown")

    def image_at(t):
        collection = blender.data.collections[name]
        motions.go_to(blender, collection, t)
        return shown(collection.children["Cameras"])

    assert image_at(scenes.T_MAX) == {"away": ["0002.png"]}
    blender.ops.ed.undo()
    assert image_at(0.0) == {}
    blender.ops.ed.redo()
    assert image_at(0.0) == {"away": ["0000.png"]}
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert image_at(0.5 * scenes.T_MAX) == {"away": ["0001.png"]}


def test_showing_images_again_keeps_other_backgrounds_and_leaves_no_images(blender, captured, tmp_path):
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"))
    png(tmp_path / "data" / "upright.png", 1)
    png(tmp_path / "own.png", 2)
    camera = collection.children["Cameras"].objects["upright"]
    camera.data.background_images.new().image = blender.data.images.load(str(tmp_path / "own.png"))
    for _ in range(2):
        blender.ops.r5dgs.show_captured_images(directory=str(tmp_path / "data"))
        assert shown(collection.children["Cameras"]) == {"upright": ["own.png", "upright.png"]}
    assert {image.name for image in blender.data.images if image.source == "FILE"} == {"own.png", "upright captured"}


def test_images_are_found_by_the_names_of_files_and_folders(blender, captured, tmp_path):
    collection = motions.load(blender, scene_file.write(captured, tmp_path / "scene.r5dgs"))
    folder, home = tmp_path / "data", collection.children["Cameras"]
    png(folder / "images" / "upright.png", 1)
    for number in range(3):
        png(folder / "images" / "away" / f"{number:04d}.png", number)
    motions.go_to(blender, collection, scenes.T_MAX)
    assert blender.ops.r5dgs.show_captured_images(directory=str(folder)) == {"FINISHED"}
    assert shown(home) == {"away": ["0002.png"], "upright": ["upright.png"]}
    for other, message in ((tmp_path / "empty", "found none"), (tmp_path, "found no image of a captured camera")):
        with pytest.raises(RuntimeError, match=message):
            blender.ops.r5dgs.show_captured_images(directory=str(other))


def test_loading_shows_the_captured_images_on_demand(blender, captured, tmp_path):
    path, folder = scene_file.write(captured, tmp_path / "scene.r5dgs"), tmp_path / "data"
    png(folder / "images" / "upright.png", 1)
    collection = motions.load(blender, path, images=str(folder))
    assert shown(collection.children["Cameras"]) == {"upright": ["upright.png"]}
    assert motions.load(blender, path, images=str(tmp_path / "missing")).r5dgs.is_scene  # a warning, not an error

"""Exported cameras are those of Blender, in any axes, for the readers of data sets."""

import json

import numpy as np
import pytest

from r5dgs_core.data import colmap_model, transforms
from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix, Vector  # noqa: E402  (bpy brings it)


@pytest.fixture
def view(blender):
    """A camera that moves, with shift, seen at a size that is not square."""
    scene = blender.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 160, 90, 50
    scene.frame_start, scene.frame_end = 1, 5
    camera = scene.camera
    camera.data.lens, camera.data.shift_x = 40, 0.1
    for frame in (1, 5):
        camera.location.x = frame
        camera.keyframe_insert("location", frame=frame)
    scene.frame_set(3)
    return camera


@pytest.fixture
def loaded(blender, tmp_path):
    made = scenes.make_scene(n=100, world_convention="colmap")
    path = scene_file.write(made, tmp_path / "scene.r5dgs")
    return motions.load_again(blender, path, fit_timeline=False, cameras=False)


def pixel(camera, point):
    """Pixel of a world point according to Blender, from the upper left corner."""
    import bpy
    from bpy_extras.object_utils import world_to_camera_view

    scene = bpy.context.scene
    x, y, z = world_to_camera_view(scene, camera, Vector(point))
    return np.array([80 * x, 45 * (1 - y), z])


def seen(matrix, intrinsics, point):
    T_cam_world = cameras.opengl_to_cam_world(matrix)
    camera = cameras.Camera(80, 45, intrinsics, T_cam_world)
    pixels, depth = cameras.project(camera, np.array([point], np.float64))
    return np.array([*pixels[0], depth[0]])


def test_exported_transforms_json_matches_blenders_camera(blender, view, tmp_path):
    assert blender.ops.r5dgs.export_cameras(directory=str(tmp_path / "out"), frame_step=2) == {"FINISHED"}
    assert blender.context.scene.frame_current == 3
    entries, rest = transforms.read(tmp_path / "out" / "transforms.json")
    assert [entry.file_path for entry in entries] == [f"images/frame_{k:04d}.png" for k in (1, 3, 5)]
    assert [entry.t for entry in entries] == [0, 0.5, 1]
    assert (rest["w"], rest["h"]) == (80, 45)
    for frame, entry in zip((1, 3, 5), entries, strict=True):
        blender.context.scene.frame_set(frame)
        for point in ((0, 0, 0), (1, 2, 0.5), (-1, 0.3, 1)):
            wanted = pixel(view, point)
            np.testing.assert_allclose(
                seen(entry.matrix, transforms.intrinsics(entry, 80, 45), point), wanted, atol=2e-3
            )


@pytest.mark.parametrize("axes", ["FILE", "COLMAP", "OPENGL"])
def test_other_axes_rotate_the_world_and_not_the_picture(blender, view, loaded, axes, tmp_path):
    loaded.r5dgs.root.scale, loaded.r5dgs.root.location = (2, 2, 2), (0, 0, 1)
    blender.context.view_layer.update()
    options = {"directory": str(tmp_path), "frames": "CURRENT", "axes": axes}
    assert blender.ops.r5dgs.export_cameras(**options) == {"FINISHED"}
    entry = transforms.read(tmp_path / "transforms.json")[0][0]
    assert entry.t == pytest.approx(2 / 60)
    world = np.eye(4)
    if axes == "FILE":
        world = np.array(loaded.r5dgs.root.matrix_world)
    else:
        world[:3, :3] = cameras.WORLD_TO_BLENDER[axes.lower()]
    point = np.array([0.3, -0.2, 0.5])
    found = seen(entry.matrix, transforms.intrinsics(entry, 80, 45), point)
    wanted = pixel(view, world[:3, :3] @ point + world[:3, 3])
    np.testing.assert_allclose(found[:2], wanted[:2], atol=2e-3)
    assert found[2] * (2 if axes == "FILE" else 1) == pytest.approx(wanted[2], rel=1e-5)


def test_colmap_text_holds_all_cameras_and_their_times(blender, view, loaded, tmp_path):
    other = blender.data.objects.new("side view/2", blender.data.cameras.new("side"))
    other.matrix_world = Matrix.Translation((0, 0, 9))
    flat = blender.data.objects.new("flat", blender.data.cameras.new("flat"))
    flat.data.type = "ORTHO"
    for obj in (other, flat):
        blender.context.scene.collection.objects.link(obj)
    options = {"directory": str(tmp_path), "which": "ALL", "format": "COLMAP", "frame_step": 4}
    assert blender.ops.r5dgs.export_cameras(**options) == {"FINISHED"}
    model = colmap_model.read(tmp_path / "sparse" / "0")
    names = [f"{name}/{frame:04d}.png" for name in ("Camera", "side_view_2") for frame in (1, 5)]
    assert [image.name for image in model.images] == names
    np.testing.assert_allclose(model.images[-1].T_cam_world @ [0, 0, 9, 1], [0, 0, 0, 1], atol=1e-6)
    assert json.loads((tmp_path / "times.json").read_text())["times"][names[1]] == pytest.approx(4 / 60)


def test_cameras_whose_names_differ_only_in_punctuation_have_separate_views(blender, view, tmp_path):
    for name in ("top view", "top_view", "Top/View", "top_view_2"):
        blender.context.scene.collection.objects.link(blender.data.objects.new(name, view.data))
    options = {"directory": str(tmp_path), "which": "ALL", "format": "COLMAP", "frames": "CURRENT"}
    assert blender.ops.r5dgs.export_cameras(**options) == {"FINISHED"}
    names = [image.name for image in colmap_model.read(tmp_path / "sparse" / "0").images]
    assert len({name.casefold() for name in names}) == len(names) == 5


def test_exporting_a_non_pinhole_camera_raises_and_writes_nothing(blender, view, tmp_path):
    view.data.type = "PANO"
    with pytest.raises(RuntimeError, match="perspective"):
        blender.ops.r5dgs.export_cameras(directory=str(tmp_path / "out"))
    view.data.type = "PERSP"
    with pytest.raises(RuntimeError, match="loaded scene"):
        blender.ops.r5dgs.export_cameras(directory=str(tmp_path / "out"), axes="FILE")
    with pytest.raises(RuntimeError, match="folder"):
        blender.ops.r5dgs.export_cameras()
    assert not (tmp_path / "out").exists()

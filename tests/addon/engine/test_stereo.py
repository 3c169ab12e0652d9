"""Each view of a stereoscopic or multi-view render is the picture of a camera at the position of its eye."""

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")

APART, CONVERGENCE = 0.4, 3.0


@pytest.fixture
def stereo(blender, tmp_path, monkeypatch):
    """Scene with a stereo camera that writes one file per eye."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    scene = scenes.make_scene(n=600, objects=3, seed=4)
    motions.load_again(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    blender.ops.r5dgs.use_engine()
    blender.ops.r5dgs.show_colors_as_trained()
    shown = blender.context.scene
    shown.frame_set(46)
    camera = shown.camera
    camera.location, camera.rotation_euler = (0, -5, 1), (1.4, 0, 0)
    camera.data.stereo.pivot = "CENTER"
    camera.data.stereo.interocular_distance, camera.data.stereo.convergence_distance = APART, CONVERGENCE
    render = shown.render
    render.resolution_x, render.resolution_y, render.resolution_percentage, render.dither_intensity = 96, 72, 100, 0
    render.use_multiview = True
    render.image_settings.views_format = "INDIVIDUAL"
    render.image_settings.file_format = "PNG"
    return shown


def render_views(bpy, folder, suffixes):
    """Images that Blender writes, by suffix. [H, W, 3] each"""
    bpy.context.scene.render.filepath = str(folder / "out.png")
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return {suffix: images.read(folder / f"out{suffix}.png")[..., :3] for suffix in suffixes}


@pytest.mark.parametrize("fit", ["HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("mode", ["PARALLEL", "OFFAXIS"])
def test_each_eye_renders_like_a_camera_at_its_position(blender, stereo, tmp_path, mode, fit):
    camera = stereo.camera
    data = camera.data
    data.stereo.convergence_mode, data.sensor_fit, data.shift_x = mode, fit, 0.05
    stereo.render.views_format = "STEREO_3D"
    found = render_views(blender, tmp_path, ("_L", "_R"))
    assert np.abs(found["_L"] - found["_R"]).max() > 0.1
    stereo.render.use_multiview = False
    rotation, place = camera.matrix_world.to_3x3(), camera.location.copy()
    for suffix, side in (("_L", -1), ("_R", 1)):
        camera.location = place + rotation.col[0] * (side * APART / 2)
        data.shift_x = 0.05
        if mode == "OFFAXIS":
            data.shift_x -= side * (APART / 2) / CONVERGENCE * data.lens / data.sensor_width  # as Blender has it
        alone = render_views(blender, tmp_path, ("",))[""]
        assert np.abs(found[suffix] - alone).max() < 2 / 255, suffix


def test_each_view_of_a_multi_camera_render_matches_its_camera(blender, stereo, tmp_path):
    camera = stereo.camera
    camera.name = "eye_L"
    other = camera.copy()
    other.name = "eye_R"
    stereo.collection.objects.link(other)
    other.location = (1, -5, 1)
    stereo.render.views_format = "MULTIVIEW"
    found = render_views(blender, tmp_path, ("_L", "_R"))
    stereo.render.use_multiview = False
    for suffix, one in (("_L", camera), ("_R", other)):
        stereo.camera = one
        assert np.abs(found[suffix] - render_views(blender, tmp_path, ("",))[""]).max() < 2 / 255


def test_a_view_that_is_switched_off_is_not_rendered(blender, stereo, tmp_path):
    stereo.render.views_format = "STEREO_3D"
    stereo.render.views["right"].use = False
    render_views(blender, tmp_path, ())
    assert len(list(tmp_path.glob("out*.png"))) == 1

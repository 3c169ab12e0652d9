"""`blender -b FILE -a`, which has no window in its context, writes the same images as F12."""

import subprocess

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.addon import conftest
from tests.support import scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")

REGISTER = f"import sys; sys.path.insert(0, {str(conftest.ROOT)!r}); from tests.blender import check_playback; "
REGISTER += "check_playback.extension_package()"


@pytest.mark.parametrize("view", ["Standard", "AgX"])
def test_the_command_line_renders_like_f12(blender, tmp_path, monkeypatch, view):
    if not blender.app.binary_path:
        pytest.skip("the module bpy has no command line")
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    scene = scenes.make_scene(n=400, objects=2, seed=4)
    blender.ops.r5dgs.load_scene(filepath=str(scene_file.write(scene, tmp_path / "scene.r5dgs")))
    shown = blender.context.scene
    shown.render.engine, shown.view_settings.view_transform = "R5DGS", view
    shown.render.resolution_x, shown.render.resolution_y, shown.render.dither_intensity = 96, 64, 0.0
    shown.frame_start, shown.frame_end = 50, 51
    shown.render.image_settings.file_format = "PNG"
    shown.camera.location, shown.camera.rotation_euler = (0, -5, 1), (1.4, 0, 0)
    blend = tmp_path / "file.blend"
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    output = ["--render-output", str(tmp_path / "####"), "--render-format", "PNG"]
    command = [blender.app.binary_path, "-b", "--factory-startup", str(blend), "--python-expr", REGISTER, *output, "-a"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    for frame in (50, 51):
        shown.frame_set(frame)
        shown.render.filepath = str(tmp_path / "f12.png")
        blender.ops.render.render(write_still=True)
        picture = images.read(tmp_path / f"{frame:04d}.png")
        assert np.ptp(picture) > 0.2
        np.testing.assert_array_equal(picture, images.read(tmp_path / "f12.png"))

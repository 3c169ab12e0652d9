"""Frames of ``r5dgs render`` equal those of the render engine for the same camera."""

import json
import math

import numpy as np
import pytest

from r5dgs_core.cli import main
from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")

SIZE = (160, 90)


@pytest.mark.slow
def test_a_frame_equals_that_of_f12(blender, tmp_path, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    scene = scenes.make_scene(n=400, objects=3, sh_degree=2, seed=4, world_convention="colmap")
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    collection = motions.load_again(blender, path)
    shown = blender.context.scene
    shown.camera.location, shown.camera.rotation_euler = (0.4, -5, 1.2), (1.4, 0, 0.05)
    blender.ops.r5dgs.use_engine()
    blender.ops.r5dgs.show_colors_as_trained()
    shown.render.resolution_x, shown.render.resolution_y = SIZE
    shown.render.resolution_percentage, shown.render.dither_intensity = 100, 0.0
    shown.render.image_settings.file_format = "PNG"
    blender.context.view_layer.update()
    root = np.array(collection.r5dgs.root.matrix_world, np.float64)
    pose = np.linalg.inv(root) @ np.array(shown.camera.matrix_world, np.float64)
    tangent = math.tan(0.5 * shown.camera.data.angle_x) * SIZE[1] / SIZE[0]
    entry = {"camera_to_world": pose.ravel().tolist(), "fov": math.degrees(2 * math.atan(tangent))}
    header = {"render_width": SIZE[0], "render_height": SIZE[1], "camera_type": "perspective", "fps": 24}
    (tmp_path / "path.json").write_text(json.dumps({**header, "camera_path": [entry]}))
    for frame in (13, 61):
        shown.frame_set(frame)
        shown.render.filepath = str(tmp_path / "f12.png")
        blender.ops.render.render(write_still=True)
        out, t = tmp_path / "film.png", str((frame - 1) / scene.frames_per_unit)
        given = ["render", str(path), "--out", str(out), "--camera", str(tmp_path / "path.json"), "--time", t]
        assert main.main([*given, "--overwrite"]) == 0
        expected, found = images.read(shown.render.filepath)[..., :3], images.read(out)
        assert np.ptp(expected) > 0.3
        assert -10 * math.log10(max(float(np.square(found - expected).mean()), 1e-12)) > 55

"""A new kind of motion with a new rate appears in Blender without further code."""

import subprocess
import sys

from r5dgs_core.scene import scene_file
from tests.support import new_kind, scenes

USE = """
import importlib.util
import sys

import bpy

root, scene_path, number = sys.argv[-3:]
spec = importlib.util.spec_from_file_location("r5dgs", root + "/__init__.py", submodule_search_locations=[root])
extension = importlib.util.module_from_spec(spec)
sys.modules["r5dgs"] = extension
spec.loader.exec_module(extension)
extension.register()
assert bpy.ops.r5dgs.load_scene(filepath=scene_path) == {"FINISHED"}
anchor = next(o for o in bpy.data.objects if o.r5dgs.role == "ANCHOR" and o.r5dgs.motion_id == 1)
state = anchor.r5dgs_motion
state.kind, state.belt_velocity = "rolling", (0.6, 0.0, 0.0)
assert state["kind"] == int(number)
rate = state.stored_belt_velocity[0]
assert 0 < rate != 0.6  # per unit of scene time
bpy.context.view_layer.objects.active = anchor
anchor.select_set(True)
assert bpy.ops.r5dgs.re_extrapolate() == {"FINISHED"}
assert bpy.ops.r5dgs.export_scene(filepath=root + "/saved.r5dgs") == {"FINISHED"}
from r5dgs.r5dgs_core.scene import scene_file
model = scene_file.read(root + "/saved.r5dgs").groups[1].model
assert model.kind == "rolling" and abs(model.belt_velocity[0] - rate) < 1e-6, model
extension.unregister()
"""


def test_the_kind_of_the_page_is_edited_and_saved_in_blender(blender, tmp_path):
    scene_file.write(scenes.make_scene(), tmp_path / "scene.r5dgs")
    arguments = new_kind.add(tmp_path / "r5dgs"), tmp_path / "scene.r5dgs", new_kind.NUMBER
    if blender.app.binary_path:
        options = ("-b", "--factory-startup", "--python-exit-code", "1", "--python-expr", USE, "--")
        command = [blender.app.binary_path, *options, *map(str, arguments)]
    else:
        command = [sys.executable, "-c", USE, *map(str, arguments)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr

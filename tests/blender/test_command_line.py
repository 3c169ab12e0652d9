"""Build, install, use and remove the extension by Blender's command line. Needs a program `blender` in the path."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from r5dgs_core.scene import scene_file
from tests.support import scenes

pytestmark = [
    pytest.mark.blender,
    pytest.mark.skipif(shutil.which("blender") is None, reason="there is no program 'blender' here"),
]

ROOT = Path(__file__).resolve().parents[2]
USING = """
import bpy, sys
assert "R5DGS_OT_load_scene" in dir(bpy.types)
assert bpy.ops.r5dgs.load_scene(filepath=sys.argv[-1]) == {"FINISHED"}
bpy.context.scene.frame_set(55)
assert bpy.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
print("USED", len(bpy.data.objects["mug"].data.points))
"""
GONE = """
import bpy
assert not [name for name in dir(bpy.types) if "R5DGS" in name.upper()]
assert not hasattr(bpy.types.Object, "r5dgs")
print("GONE")
"""


def test_blenders_command_line_installs_it_and_removes_it_without_a_trace(tmp_path):
    scene_path = scene_file.write(scenes.make_scene(n=300), tmp_path / "scene.r5dgs")
    user, out = tmp_path / "user", tmp_path / "out"
    user.mkdir()
    out.mkdir()
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user), "PYTHONPATH": ""}
    environment.pop("R5DGS_PYTHON", None)

    def blender(*arguments):
        command = ["blender", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, timeout=300)
        said = done.stdout + done.stderr
        assert done.returncode == 0 and "Traceback" not in said, said
        return said

    blender("--command", "extension", "validate", ROOT)
    blender("--command", "extension", "build", "--source-dir", ROOT, "--output-dir", out)
    (archive,) = out.glob("*.zip")
    blender("--command", "extension", "validate", archive)
    blender("--command", "extension", "install-file", "-r", "user_default", "--enable", archive)
    (tmp_path / "using.py").write_text(USING)
    (tmp_path / "gone.py").write_text(GONE)
    used = blender("-b", "--python-exit-code", "1", "--python", tmp_path / "using.py", "--", scene_path)
    assert "USED" in used
    blender("--command", "extension", "remove", "r5dgs")
    assert "GONE" in blender("-b", "--python-exit-code", "1", "--python", tmp_path / "gone.py")
    assert [str(path) for path in user.rglob("*r5dgs*")] == []

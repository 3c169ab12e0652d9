"""`check_playback.py` in the bpy module, in a second process."""

import subprocess
import sys
from pathlib import Path

import pytest

from r5dgs_core.scene import scene_file
from tests.support import scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

pytestmark = pytest.mark.blender

SCRIPT = Path(__file__).with_name("check_playback.py")


def check(*arguments):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments), "--worker", sys.executable],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip


@pytest.mark.slow
def test_a_synthetic_scene_plays_and_previews_like_the_core(tmp_path):
    scene = scenes.make_scene(n=800, objects=5, sh_degree=2, world_convention="opengl")
    done = check(scene_file.write(scene, tmp_path / "scene.r5dgs"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "OK" in done.stdout and done.stdout.count("preview against core") == 3
    assert done.stdout.count("render against core") == 3


def test_a_damaged_scene_fails_the_check(tmp_path):
    path = scene_file.write(scenes.make_scene(n=50), tmp_path / "scene.r5dgs")
    path.write_bytes(path.read_bytes()[:200])
    assert check(path).returncode != 0

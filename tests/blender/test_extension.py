"""Build, validate and install the extension into an empty user folder, use it without torch, and remove it."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from r5dgs_core.scene import scene_file
from tests import test_layers
from tests.support import scenes

bpy = pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

pytestmark = pytest.mark.blender

ROOT = Path(__file__).resolve().parents[2]

SESSION = r"""
import importlib.abc, json, os, sys

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "numba", "r5dgs_core"):
            raise ModuleNotFoundError(f"No module named {name!r} (blocked by the test)", name=name)

sys.meta_path.insert(0, Blocked())
import bpy
import addon_utils

archive, scene_path, *others = sys.argv[1:]
reloading = others == ["reloading"]
module = "bl_ext.user_default.r5dgs"


def traces():
    found = [name for name in dir(bpy.types) if "R5DGS" in name.upper()]
    for name in dir(bpy.app.handlers):
        listening = getattr(bpy.app.handlers, name)
        if isinstance(listening, list):
            found += [f for f in listening if getattr(f, "__module__", "").startswith(module)]
    for owner in ("Object", "Collection", "Scene", "WindowManager"):
        found += [p.identifier for p in getattr(bpy.types, owner).bl_rna.properties if "r5dgs" in p.identifier.lower()]
    return found


seen = []
for turn in range(2):
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    assert bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    ) == {"FINISHED"}
    assert addon_utils.check(module)[1], "not enabled"
    preferences = bpy.context.preferences.addons[module].preferences
    preferences.worker_python = ""
    assert bpy.ops.r5dgs.load_scene(filepath=scene_path) == {"FINISHED"}
    bpy.context.scene.frame_set(55)
    assert bpy.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    mug = bpy.data.objects["mug"]
    seen.append([mug.matrix_world[i][3] for i in range(3)] + [len(mug.data.points)])
    if reloading:
        bpy.ops.script.reload()  # Blender's Reload Scripts
        assert addon_utils.check(module)[1] and traces(), "not enabled after reloading"
        assert [c.r5dgs.gaussians for c in bpy.data.collections if c.r5dgs.is_scene] == [300]
        assert bpy.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
        assert bpy.ops.r5dgs.load_scene(filepath=scene_path) == {"FINISHED"}
    addon_utils.disable(module, default_set=True)
    assert traces() == [], traces()
    bpy.context.scene.frame_set(20)  # the motion plays on without the extension
    repositories = list(bpy.context.preferences.extensions.repos)
    index = next(i for i, repository in enumerate(repositories) if repository.module == "user_default")
    assert bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="r5dgs") == {"FINISHED"}
    for name in [name for name in sys.modules if name.startswith(module)]:
        del sys.modules[name]
loaded = sorted(name for name in sys.modules if name.split(".")[0] in ("torch", "numba", "scipy"))
print("RESULT " + json.dumps({"seen": seen, "loaded": loaded}), flush=True)
if reloading:
    os._exit(0)  # the bpy module of 4.2 crashes at its end once scripts were reloaded, with or without extensions
"""


def cli(*arguments):
    """Run Blender's extension command line without a window."""
    import bl_pkg

    script = Path(bl_pkg.__file__).parent / "cli" / "blender_ext.py"
    done = subprocess.run([sys.executable, str(script), *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("zip")
    cli("validate", ROOT)
    cli("build", "--source-dir", ROOT, "--output-dir", folder)
    (result,) = folder.glob("*.zip")
    return result


def test_the_archive_validates_and_holds_the_extension_only(archive):
    cli("validate", archive)
    names = zipfile.ZipFile(archive).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {"blender_manifest.toml", "__init__.py", "LICENSE", "operators", "r5dgs_addon", "r5dgs_core"} <= tops
    assert tops <= {
        "blender_manifest.toml", "__init__.py", "LICENSE", "README.md", "CHANGELOG.md",
        "docs", "operators", "r5dgs_addon", "r5dgs_core",
    }  # fmt: skip
    pages = {path.relative_to(ROOT).as_posix() for path in (ROOT / "docs" / "user").glob("*.md")}
    assert {name for name in names if name.startswith("docs/") and not name.endswith("/")} == pages
    rooms = ("operators", "r5dgs_addon", *(f"r5dgs_core/{room}" for room in test_layers.PICTURE))
    needed = {path.relative_to(ROOT).as_posix() for room in rooms for path in (ROOT / room).rglob("*.py")}
    needed |= {f"r5dgs_core/{name}.py" for name in test_layers.PICTURE if (ROOT / f"r5dgs_core/{name}.py").exists()}
    assert needed <= set(names)
    core = {name.split("/")[1].removesuffix(".py") for name in names if name.startswith("r5dgs_core/")}
    assert core - test_layers.PICTURE == {"__init__"}
    assert not [name for name in names if name.endswith((".pyc", ".r5dgs", ".png", ".nbi", ".nbc"))]
    assert archive.stat().st_size < 2_000_000


@pytest.mark.default_cases("plain")
@pytest.mark.parametrize("options", [[], ["reloading"]], ids=["plain", "reloading scripts"])
def test_installs_works_without_torch_and_goes_away_twice_in_a_row(archive, tmp_path, options):
    scene_path = scene_file.write(scenes.make_scene(n=300), tmp_path / "scene.r5dgs")
    script = tmp_path / "session.py"
    script.write_text(SESSION)
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user"), "PYTHONPATH": ""}
    environment.pop("R5DGS_PYTHON", None)
    done = subprocess.run(
        [sys.executable, str(script), str(archive), str(scene_path), *options],
        capture_output=True, text=True, env=environment, cwd=tmp_path, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    result = json.loads(line.removeprefix("RESULT "))
    assert result["loaded"] == []
    assert result["seen"][0] == result["seen"][1] and result["seen"][0][3] > 0
    assert leftovers(tmp_path / "user") == []


def leftovers(folder):
    """Files and folders in a user folder whose names contain the extension's id."""
    return [str(path) for path in folder.rglob("*r5dgs*")]

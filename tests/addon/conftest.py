"""Fixtures of the add-on's tests: extension loaded once as package `r5dgs`, factory settings for each test.

Modules that need another scene override ``scene_path`` or ``loaded``.
"""

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
from pathlib import Path

import pytest

from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

ROOT = Path(__file__).resolve().parents[2]
CORE = "r5dgs.r5dgs_core"


class _OneCore(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Importer that resolves `r5dgs.r5dgs_core.x` to `r5dgs_core.x`, so that both names have the same classes."""

    def find_spec(self, fullname, path=None, target=None):
        if fullname == CORE or fullname.startswith(CORE + "."):
            return importlib.machinery.ModuleSpec(fullname, self)
        return None

    def create_module(self, spec):
        module = importlib.import_module(spec.name.removeprefix("r5dgs."))
        self._own_spec = module.__spec__
        return module

    def exec_module(self, module):
        module.__spec__ = self._own_spec  # importlib has stored that of the alias


def load_extension():
    """Load the repository root as package `r5dgs`, once.

    In a folder named `r5dgs`, pytest itself has already loaded it under that name.
    """
    if not any(isinstance(finder, _OneCore) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OneCore())
    if "r5dgs" not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            "r5dgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
        )
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["r5dgs"] = module
        spec.loader.exec_module(module)
    return sys.modules["r5dgs"]


@pytest.fixture(scope="session")
def extension():
    """The extension, registered for the whole session."""
    pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
    module = load_extension()
    module.register()
    yield module
    module.unregister()


@pytest.fixture(autouse=True)
def blender(extension):
    """The module `bpy` with factory settings."""
    import bpy

    bpy.ops.wm.read_homefile(app_template="")
    return bpy


@pytest.fixture(scope="session")
def scene_contents(tmp_path_factory):
    """Bytes of a scene file with five objects."""
    path = tmp_path_factory.mktemp("scene") / "synthetic.r5dgs"
    return scene_file.write(scenes.make_scene(n=400, objects=5, seed=1), path).read_bytes()


@pytest.fixture
def scene_path(scene_contents, tmp_path):
    """File of a synthetic scene of five objects in the folder of the test."""
    path = tmp_path / "synthetic.r5dgs"
    path.write_bytes(scene_contents)
    return path


@pytest.fixture
def loaded(blender, scene_path):
    """Collection of the loaded scene."""
    return motions.load_again(blender, scene_path)


@pytest.fixture
def mug(blender, loaded):
    """Anchor of the loaded scene's first object, selected."""
    anchor = blender.data.objects["mug anchor"]
    motions.choose(blender, anchor)
    return anchor

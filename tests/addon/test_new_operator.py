"""A new operator is one file: the example of docs/developer/extending.md works, and leaves nothing behind."""

import importlib
import sys

import pytest

from tests.support import motions, pages, registrations

NAME = "count_cameras"


@pytest.fixture
def operators(extension, tmp_path, monkeypatch):
    """The extension's operators with the example of the page as a further file."""
    (code,) = pages.blocks(pages.EXTENDING, "Operator in Blender")
    folder = tmp_path / "operators"
    folder.mkdir()
    (folder / f"{NAME}.py").write_text(code)
    module = importlib.import_module("r5dgs.operators")
    extension.unregister()
    with monkeypatch.context() as patch:
        patch.setattr(module, "__path__", [*module.__path__, str(folder)])
        extension.register()
        yield module
        extension.unregister()
    sys.modules.pop(f"{module.__name__}.{NAME}", None)
    vars(module).pop(NAME, None)
    extension.register()


def test_the_example_of_the_page_adds_an_operator(blender, extension, operators, scene_path, capfd):
    assert f"r5dgs.{NAME}" in {cls.bl_idname for module in operators.modules() for cls in module.CLASSES}
    assert not blender.ops.r5dgs.count_cameras.poll()
    motions.load(blender, scene_path)
    assert blender.ops.r5dgs.count_cameras() == {"FINISHED"}
    assert f"{scene_path.name}: 2 cameras" in capfd.readouterr().out
    scene_path.unlink()
    with pytest.raises(RuntimeError, match="Scene File"):
        blender.ops.r5dgs.count_cameras()
    assert "R5DGS_OT_count_cameras" in registrations.traces(blender)
    extension.unregister()
    try:
        assert registrations.traces(blender) == set()
    finally:
        extension.register()

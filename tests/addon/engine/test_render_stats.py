"""The measurements of `tests/blender/run.py` fail if Blender's result differs from the core's."""

import importlib

import pytest

from r5dgs_core.scene import scene_file
from tests.support import scenes


@pytest.fixture
def program():
    """`run.py` as a module, in a Blender that the extension is registered in."""
    return importlib.import_module("tests.blender.run")


def test_positions_and_keys_fail_if_blender_plays_something_else(program, tmp_path, monkeypatch, blender):
    path = scene_file.write(scenes.make_scene(n=120, objects=2), tmp_path / "scene.r5dgs")
    modules = {
        name: importlib.import_module(f"r5dgs.r5dgs_core.{room}.{name}")
        for room, name in (("scene", "cameras"), ("playback", "scene_player"), ("scene", "scene_file"))
    }
    table = program.Table()
    program.measure_positions(table, path, modules)
    program.measure_keys(table, path, modules, "r5dgs")
    assert len(table.rows) == 3 and not table.failed
    load = program.load

    def shifted(*arguments, **options):
        collection, *rest = load(*arguments, **options)
        collection.r5dgs.root.location.x += 0.01
        return collection, *rest

    monkeypatch.setattr(program, "load", shifted)
    program.measure_positions(table, path, modules)
    assert len(table.failed) == 2

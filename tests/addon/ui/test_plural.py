"""Counts in messages use singular and plural forms."""

import importlib

import pytest

from r5dgs_core.scene import scene_file
from tests.support import scenes


@pytest.mark.parametrize(
    ("count", "things", "done"),
    [
        (0, "0 Gaussians", "0 Gaussians bend"),
        (1, "1 Gaussian", "1 Gaussian bends"),
        (40_000, "40,000 Gaussians", "40,000 Gaussians bend"),
    ],
)
def test_plural_follows_the_count(blender, count, things, done):
    amounts = importlib.import_module("r5dgs.r5dgs_addon.ui.plural")
    assert amounts.of(count, "Gaussian") == things and amounts.of(count, "Gaussian", "bend") == done


def test_loading_one_object_reports_the_singular(blender, tmp_path, capfd):
    path = scene_file.write(scenes.make_scene(n=40, objects=1, seed=1), tmp_path / "one.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    assert "one.r5dgs: 40 Gaussians, 1 object\n" in capfd.readouterr().out

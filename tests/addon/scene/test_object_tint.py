"""A tint recolours an object in viewports, is reversible, and stays with the object."""

import importlib

import numpy as np
import pytest

from r5dgs_core.color import srgb
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

TINT = (0.25, 0.5, 1.0)


@pytest.fixture
def mug(blender, tmp_path):
    path = scene_file.write(scenes.make_scene(n=300, sh_degree=1), tmp_path / "scene.r5dgs")
    motions.load_again(blender, path)
    return blender.data.objects["mug"]


def shown(cloud):
    values = np.empty(4 * len(cloud.data.points), np.float32)
    cloud.data.attributes["display_color"].data.foreach_get("color", values)
    return values.reshape(-1, 4)


def linear(colors):
    return srgb.to_linear(np.minimum(colors, 1))


def test_a_new_cloud_has_no_tint(mug):
    look = importlib.import_module("r5dgs.r5dgs_addon.scene.object_tint")
    assert not look.is_tinted(mug) and tuple(look.tint(mug)) == (1, 1, 1)


def test_a_tint_multiplies_the_display_referred_colours(mug):
    base = np.empty(4 * len(mug.data.points), np.float32)
    mug.data.attributes["radiance:base"].data.foreach_get("color", base)
    colors = 0.5 + 0.28209479177387814 * base.reshape(-1, 4)[:, :3]
    opacities = shown(mug)[:, 3]
    mug.r5dgs_look.tint = TINT
    np.testing.assert_allclose(shown(mug)[:, :3], linear(colors * TINT), atol=1e-5)
    np.testing.assert_array_equal(shown(mug)[:, 3], opacities)
    np.testing.assert_allclose(mug.color[:3], linear(TINT), atol=1e-6)


def test_taking_the_tint_back_restores_every_colour(mug):
    colors, color = shown(mug), tuple(mug.color)
    mug.r5dgs_look.tint = (0.0, 0.0, 0.0)
    mug.r5dgs_look.tint = TINT
    mug.r5dgs_look.tint = (1.0, 1.0, 1.0)
    np.testing.assert_allclose(shown(mug), colors, atol=1e-6)
    assert tuple(mug.color) == color


def test_only_the_tinted_one_of_two_that_share_their_points_changes(blender, mug):
    twin = mug.copy()
    mug.users_collection[0].objects.link(twin)
    assert twin.data == mug.data
    before = shown(mug)
    twin.r5dgs_look.tint = TINT
    np.testing.assert_array_equal(shown(mug), before)
    assert not np.allclose(shown(twin), before)


def test_a_tint_survives_saving_and_reloading(blender, mug, tmp_path):
    mug.r5dgs_look.tint = TINT
    expected = shown(mug)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    again = blender.data.objects["mug"]
    assert tuple(again.r5dgs_look.tint) == TINT
    np.testing.assert_array_equal(shown(again), expected)
    again.r5dgs_look.tint = (1.0, 1.0, 1.0)
    assert not np.allclose(shown(again), expected)


def test_an_override_of_a_linked_scene_keeps_a_tint_of_its_own(blender, mug, tmp_path):
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "overriding.blend"))
    with blender.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    override = target.collections[0].override_hierarchy_create(
        blender.context.scene, blender.context.view_layer, do_fully_editable=True
    )
    override.all_objects["mug"].r5dgs_look.tint = TINT
    blender.ops.wm.save_mainfile()
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "overriding.blend"))
    again = next(obj for obj in blender.data.objects if obj.name == "mug" and obj.library is None)
    assert tuple(again.r5dgs_look.tint) == TINT
    np.testing.assert_allclose(again.color[:3], linear(TINT), atol=1e-6)

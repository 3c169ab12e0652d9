"""The list of objects shows, selects, hides and recolours the scene's objects."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes

TINT = (0.25, 0.5, 1.0)


@pytest.fixture
def loaded(blender, tmp_path):
    path = scene_file.write(scenes.make_scene(n=300), tmp_path / "scene.r5dgs")
    motions.load_again(blender, path)
    return scene_of(blender)


def scene_of(bpy):
    return next(c for c in bpy.data.collections if c.r5dgs.is_scene)


def row_of(collection, name):
    return next(entry for entry in collection.r5dgs.table if entry.label == name)


def drawn(bpy, collection, name):
    """Texts in the row of an object."""
    said = []
    lists = importlib.import_module("r5dgs.r5dgs_addon.panels.objects")
    layout = layouts.Layout(bpy, said)
    lists.R5DGS_UL_objects.draw_item(None, bpy.context, layout, None, row_of(collection, name), 0, None, "")
    return said


def test_a_row_shows_the_number_of_gaussians_and_the_kind_of_motion(blender, loaded):
    said = drawn(blender, loaded, "mug")
    entry = row_of(loaded, "mug")
    assert {"color", "label", "hidden", "hidden_in_renders", f"{entry.count:,}"} <= set(said)
    anchor = blender.data.objects["mug anchor"]
    kinds = anchor.r5dgs_motion.bl_rna.properties["kind"].enum_items
    assert kinds[anchor.r5dgs_motion.kind].name in said


def test_a_deleted_object_is_shown_as_deleted(blender, loaded):
    blender.data.objects.remove(blender.data.objects["mug"])
    said = drawn(blender, loaded, "mug")
    assert "deleted" in said and "hidden" not in said


def test_choosing_a_row_selects_and_the_selection_shows_in_the_list(blender, loaded):
    names = [entry.label for entry in loaded.r5dgs.table]
    loaded.r5dgs.row = names.index("toy car")
    assert {obj.name for obj in blender.context.selected_objects} == {"toy car", "toy car anchor"}
    blender.context.view_layer.objects.active = blender.data.objects["mug"]
    assert loaded.r5dgs.row == names.index("mug")
    blender.context.view_layer.objects.active = blender.data.objects["Cube"]
    assert loaded.r5dgs.row == -1
    loaded.r5dgs.row = 99
    assert loaded.r5dgs.row == -1


def test_eyes_hide_the_clouds_of_an_object_and_nothing_else(blender, loaded):
    entry = row_of(loaded, "mug")
    before = {obj.name: (obj.hide_get(), obj.hide_render) for obj in blender.context.scene.objects}
    entry.hidden = True
    assert entry.hidden and not entry.hidden_in_renders
    entry.hidden_in_renders = True
    after = {obj.name: (obj.hide_get(), obj.hide_render) for obj in blender.context.scene.objects}
    assert after == before | {"mug": (True, True)}
    entry.hidden = entry.hidden_in_renders = False
    assert {obj.name: (obj.hide_get(), obj.hide_render) for obj in blender.context.scene.objects} == before


def test_colours_of_rows_are_the_mean_of_the_object_times_its_tint(blender, loaded):
    scene = scenes.make_scene(n=300)
    entry, rows = row_of(loaded, "mug"), scene.gaussians.object_ids == 1
    shown = np.clip(0.5 + 0.28209479177387814 * scene.gaussians.sh[rows, 0], 0, 1)
    weights = 1 / (1 + np.exp(-scene.gaussians.opacity_logits[rows]))
    mean = (weights[:, None] * shown).sum(0) / weights.sum()
    np.testing.assert_allclose(entry.color, mean, atol=1e-3)
    entry.tint = TINT
    np.testing.assert_allclose(blender.data.objects["mug"].r5dgs_look.tint, TINT, atol=1e-6)
    np.testing.assert_allclose(entry.color, mean * TINT, atol=1e-3)
    np.testing.assert_allclose(entry.tint, TINT, atol=1e-6)
    entry.tint = (1.0, 1.0, 1.0)
    np.testing.assert_allclose(entry.color, mean, atol=1e-3)


def test_recolouring_takes_all_clouds_of_the_selected_objects(blender, loaded):
    blender.ops.r5dgs.select_by_prompt(text="mug")
    blender.ops.object.duplicate()
    blender.ops.r5dgs.select_by_prompt(text="mug, car")
    assert not blender.ops.r5dgs.reset_color.poll()
    assert blender.ops.r5dgs.recolor(tint=TINT) == {"FINISHED"}
    look = importlib.import_module("r5dgs.r5dgs_addon.scene.object_tint")

    def tinted():
        return {obj.name for obj in loaded.all_objects if look.is_tinted(obj)}

    assert tinted() == {"mug", "mug.001", "toy car"}
    blender.ops.r5dgs.select_by_prompt(text="mug")
    assert blender.ops.r5dgs.reset_color() == {"FINISHED"}
    assert tinted() == {"toy car"}


def test_recolouring_can_be_undone_and_redone(blender, loaded):
    def state():
        cloud = blender.data.objects["mug"]
        values = np.empty(4 * len(cloud.data.points), np.float32)
        cloud.data.attributes["display_color"].data.foreach_get("color", values)
        return tuple(cloud.r5dgs_look.tint), tuple(cloud.color), values.tobytes()

    blender.ops.r5dgs.select_by_prompt(text="mug")
    blender.ops.ed.undo_push(message="before")
    states = [state()]
    for call in (lambda: blender.ops.r5dgs.recolor(tint=TINT), blender.ops.r5dgs.reset_color):
        call()
        blender.ops.ed.undo_push(message="colour")
        states.append(state())
    assert states[0][0] == states[2][0] == (1, 1, 1) and states[1][0] == TINT
    blender.ops.ed.undo()
    assert state() == states[1]
    blender.ops.ed.undo()
    assert state() == states[0]
    blender.ops.ed.redo()
    assert state() == states[1]


def test_in_a_linked_scene_only_local_properties_change(blender, loaded, tmp_path):
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    with blender.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    linked = target.collections[0]
    blender.context.scene.collection.children.link(linked)
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    assert {obj.name for obj in blender.context.selected_objects} == {"mug", "mug anchor"}
    assert blender.ops.r5dgs.recolor(tint=TINT) == {"CANCELLED"}
    assert blender.ops.r5dgs.add_alias(word="beaker") == {"CANCELLED"}
    with pytest.raises(RuntimeError, match="linked"):
        blender.ops.r5dgs.rename_object(new_name="beaker")
    row_of(linked, "mug").label = "beaker"
    row_of(linked, "mug").tint = TINT
    row_of(linked, "mug").hidden_in_renders = True
    mug = linked.all_objects["mug"]
    assert tuple(mug.r5dgs_look.tint) == (1, 1, 1) and not mug.hide_render
    assert blender.ops.r5dgs.isolate() == {"FINISHED"}
    clouds = [obj for obj in linked.all_objects if obj.r5dgs.role == "CLOUD"]
    assert [obj.name for obj in clouds if obj.visible_get()] == ["mug"] and not any(o.hide_render for o in clouds)
    blender.ops.r5dgs.unisolate()
    assert all(obj.visible_get() for obj in clouds)


def test_resetting_a_linked_tint_is_refused_with_a_report(blender, loaded, tmp_path, capfd):
    loaded.all_objects["mug"].r5dgs_look.tint = TINT
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    with blender.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    blender.context.scene.collection.children.link(target.collections[0])
    blender.ops.r5dgs.select_by_prompt(text="mug")
    assert blender.ops.r5dgs.reset_color() == {"CANCELLED"}
    assert "first make a library override of: mug" in capfd.readouterr().out


def test_the_list_filters_by_the_names_that_it_shows(blender, loaded):
    lists = importlib.import_module("r5dgs.r5dgs_addon.panels.objects")
    row_of(loaded, "mug").label = "Teapot"
    shown = SimpleNamespace(filter_name="teapot", bitflag_filter_item=1 << 30)
    flags, order = lists.R5DGS_UL_objects.filter_items(shown, blender.context, loaded.r5dgs, "table")
    assert order == [] and [bool(flag) for flag in flags] == [e.label == "Teapot" for e in loaded.r5dgs.table]
    shown.filter_name = ""
    assert lists.R5DGS_UL_objects.filter_items(shown, blender.context, loaded.r5dgs, "table") == ([], [])


def test_the_panel_shows_the_active_object_and_its_words(blender, loaded):
    lists = importlib.import_module("r5dgs.r5dgs_addon.panels.objects")
    loaded.r5dgs.row = [entry.label for entry in loaded.r5dgs.table].index("toy car")
    said = layouts.draw(blender, *lists.CLASSES)
    assert {"vehicle", "racer", "r5dgs.add_alias", "tint", "click_selects_anchor", "r5dgs.isolate"} <= set(said)
    assert "r5dgs.unisolate" not in said
    blender.ops.r5dgs.isolate()
    assert "r5dgs.unisolate" in layouts.draw(blender, *lists.CLASSES)

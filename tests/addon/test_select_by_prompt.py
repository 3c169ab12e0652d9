"""Words select objects by the table that the .blend file keeps."""

import dataclasses
import importlib

import pytest

from r5dgs_core.scene import scene_file
from tests import scenes


@pytest.fixture
def loaded(blender, tmp_path):
    path = scene_file.write(scenes.make_scene(n=300, objects=6), tmp_path / "scene.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    path.unlink()  # the file is not needed any more
    return next(c for c in blender.data.collections if c.r5dgs.is_scene)


def ask(bpy, text, mode="SET"):
    return bpy.ops.r5dgs.select_by_prompt(text=text, mode=mode)


def selected_ids(bpy):
    return {obj.r5dgs.object_id for obj in bpy.context.selected_objects if obj.r5dgs.role != "NONE"}


def test_a_name_selects_the_clouds_and_the_anchor_of_its_object(blender, loaded):
    assert ask(blender, "the mug") == {"FINISHED"}
    assert {obj.name for obj in blender.context.selected_objects} == {"mug", "mug anchor"}
    assert blender.context.view_layer.objects.active.name == "mug anchor"


@pytest.mark.parametrize(("text", "object_id"), [("cup", 1), ("Cups", 1), ("a MUG", 1), ("red aple", 2), ("glob", 6)])
def test_aliases_plurals_and_typos_find_it(blender, loaded, text, object_id):
    ask(blender, text)
    assert selected_ids(blender) == {object_id}


def test_what_an_object_answers_to_is_kept_word_for_word(blender, tmp_path):
    made = scenes.make_scene(n=100, objects=1)
    words = ("cup, blue", "", " mug ", "tasse")
    table = tuple(dataclasses.replace(item, aliases=words) if item.id == 1 else item for item in made.objects)
    path = scene_file.write(dataclasses.replace(made, objects=table), tmp_path / "words.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "words.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "words.blend"))
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    table = importlib.import_module("r5dgs.r5dgs_addon.table")
    assert [label.aliases for label in table.labels(collection) if label.object_id == 1] == [words]


def test_several_wishes_select_several_objects_ranked_in_the_panel(blender, loaded):
    ask(blender, "mug and fruit")
    assert selected_ids(blender) == {1, 2, 4}
    matches = blender.context.window_manager.r5dgs_words.matches
    assert matches[0].name == "mug" and matches[0].score == pytest.approx(1.0)
    scores = [match.score for match in matches]
    assert scores == sorted(scores, reverse=True) and all(match.why for match in matches)


def test_modes_set_add_and_subtract(blender, loaded):
    ask(blender, "mug")
    ask(blender, "globe", "ADD")
    assert selected_ids(blender) == {1, 6}
    ask(blender, "cup", "SUBTRACT")
    assert selected_ids(blender) == {6}
    ask(blender, "lemon")
    assert selected_ids(blender) == {4}


def test_nothing_matching_is_said_and_leaves_the_selection(blender, loaded):
    ask(blender, "mug")
    assert ask(blender, "submarine") == {"CANCELLED"}
    session = blender.context.window_manager.r5dgs_words
    assert selected_ids(blender) == {1}
    assert session.asked == "submarine" and len(session.matches) == 0


def test_hidden_objects_are_not_selected(blender, loaded):
    loaded.all_objects["mug"].hide_set(True)
    ask(blender, "mug")
    assert {obj.name for obj in blender.context.selected_objects} == {"mug anchor"}


def test_the_unassigned_answer_to_nothing_and_the_background_to_its_name(blender, loaded):
    assert ask(blender, "unassigned") == {"CANCELLED"}
    ask(blender, "background")
    assert selected_ids(blender) == {0}


def test_the_sidebars_field_is_asked_where_no_text_is_given(blender, loaded):
    blender.context.window_manager.r5dgs_words.prompt = "toy car"
    assert blender.ops.r5dgs.select_by_prompt() == {"FINISHED"}
    assert selected_ids(blender) == {3}
    blender.context.window_manager.r5dgs_words.prompt = "  "
    assert blender.ops.r5dgs.select_by_prompt() == {"CANCELLED"}


def test_words_survive_saving_and_reloading(blender, loaded, tmp_path):
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.read_homefile(app_template="")
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    ask(blender, "citrus")
    assert selected_ids(blender) == {4}


def test_without_a_scene_the_operators_cannot_be_called(blender):
    for operator in (blender.ops.r5dgs.select_by_prompt, blender.ops.r5dgs.preview):
        assert not operator.poll()

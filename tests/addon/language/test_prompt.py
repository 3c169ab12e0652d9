"""Words select objects by the table stored in the .blend file."""

import dataclasses
import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes


@pytest.fixture
def loaded(blender, tmp_path):
    path = scene_file.write(scenes.make_scene(n=300, objects=6), tmp_path / "scene.r5dgs")
    motions.load_again(blender, path)
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


def test_aliases_are_kept_verbatim(blender, tmp_path):
    made = scenes.make_scene(n=100, objects=1)
    words = ("cup, blue", "", " mug ", "tasse")
    table = tuple(dataclasses.replace(item, aliases=words) if item.id == 1 else item for item in made.objects)
    path = scene_file.write(dataclasses.replace(made, objects=table), tmp_path / "words.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "words.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "words.blend"))
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    table = importlib.import_module("r5dgs.r5dgs_addon.scene.object_names")
    assert [label.aliases for label in table.labels(collection) if label.object_id == 1] == [words]


def test_several_phrases_select_several_objects_ranked_in_the_panel(blender, loaded):
    ask(blender, "mug and fruit")
    assert selected_ids(blender) == {1, 2, 4}
    matches = blender.context.window_manager.r5dgs_words.matches
    assert matches[0].name == "mug" and matches[0].score == pytest.approx(1.0)
    scores = [match.score for match in matches]
    assert scores == sorted(scores, reverse=True) and all(match.why for match in matches)


def test_a_phrase_without_match_is_named_beside_others(blender, loaded, capfd):
    assert ask(blender, "mug and elephant") == {"FINISHED"}
    assert "Nothing matches 'elephant'" in capfd.readouterr().out
    assert ask(blender, "mug and lemon") == {"FINISHED"}
    assert "Nothing matches" not in capfd.readouterr().out


def test_modes_set_add_and_subtract(blender, loaded):
    ask(blender, "mug")
    ask(blender, "globe", "ADD")
    assert selected_ids(blender) == {1, 6}
    ask(blender, "cup", "SUBTRACT")
    assert selected_ids(blender) == {6}
    ask(blender, "lemon")
    assert selected_ids(blender) == {4}


def test_a_prompt_without_matches_keeps_the_selection(blender, loaded):
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


def test_without_text_the_prompt_of_the_sidebar_is_used(blender, loaded):
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


def session(bpy):
    return bpy.context.window_manager.r5dgs_words


def test_enter_in_the_field_lists_matches_and_leaves_the_selection(blender, loaded):
    ask(blender, "globe")
    session(blender).prompt = "mug and fruit"
    assert [match.object_id for match in session(blender).matches] == [1, 2, 4]
    assert selected_ids(blender) == {6}
    session(blender).prompt = ""
    assert len(session(blender).matches) == 0 and session(blender).asked == ""


def test_the_threshold_decides_what_matches(blender, loaded):
    session(blender).prompt = "coffee mug"
    assert [match.object_id for match in session(blender).matches] == [1]
    blender.context.scene.r5dgs_words.threshold = 0.95
    assert len(session(blender).matches) == 0
    assert ask(blender, "coffee mug") == {"CANCELLED"}
    assert blender.ops.r5dgs.select_by_prompt(text="coffee mug", threshold=0.3) == {"FINISHED"}
    assert blender.context.scene.r5dgs_words.threshold == pytest.approx(0.3)


def test_similar_names_are_reported_and_suggested(blender, loaded, capfd):
    assert ask(blender, "bug") == {"CANCELLED"}
    assert "did you mean 'mug'" in capfd.readouterr().out
    assert [item.name for item in session(blender).meant][0] == "mug"
    ask(blender, "zzz")
    assert "the scene has: background, mug" in capfd.readouterr().out
    assert len(session(blender).meant) == 0


def test_prompts_with_matches_are_saved_with_the_file(blender, loaded, tmp_path):
    def history():
        return [item.name for item in blender.context.scene.r5dgs_words.history]

    for text in ("mug", "zzz", "globe", " mug ", "car"):
        ask(blender, text)
    assert history() == ["car", "mug", "globe"]
    for number in range(20):
        ask(blender, "mug" + " " * number + "and car")
        ask(blender, f"car and {number}")
    assert len(history()) == 12 and history()[0] == "car and 19"
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    kept = history()
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert history() == kept


def test_the_panel_offers_earlier_prompts_and_suggestions(blender, loaded):
    panel = importlib.import_module("r5dgs.r5dgs_addon.panels.prompt")

    def earlier():
        said = []
        panel.R5DGS_MT_prompts.draw(SimpleNamespace(layout=layouts.Layout(blender, said)), blender.context)
        return [text for text in said if text != "r5dgs.select_by_prompt"]

    assert earlier() == ["None yet"]
    ask(blender, "globe")
    ask(blender, "mug")
    ask(blender, "bug")
    assert earlier() == ["mug", "globe"]
    said = layouts.draw(blender, *panel.CLASSES)
    assert {"Nothing matches 'bug'", "Did you mean", "mug", "R5DGS_MT_prompts", "threshold"} <= set(said)
    assert "all_scenes" not in said
    loaded.all_objects["globe"].name = "planet"
    ask(blender, "earth")
    assert "planet" in layouts.draw(blender, *panel.CLASSES)


def test_a_click_on_a_match_selects_that_one(blender, loaded):
    ask(blender, "fruit")
    assert blender.ops.r5dgs.select_object(scene=loaded.name, object_id=4) == {"FINISHED"}
    assert selected_ids(blender) == {4}
    blender.ops.r5dgs.select_object(object_id=1, mode="ADD")
    assert selected_ids(blender) == {1, 4} and blender.context.view_layer.objects.active.name == "mug anchor"
    blender.ops.r5dgs.select_object(object_id=4, mode="SUBTRACT")
    assert selected_ids(blender) == {1}
    assert blender.ops.r5dgs.select_object(object_id=99) == {"CANCELLED"}
    assert blender.ops.r5dgs.select_object(scene="elsewhere", object_id=1) == {"CANCELLED"}


def test_duplicates_are_selected_with_their_object(blender, loaded):
    ask(blender, "mug")
    blender.ops.object.duplicate()
    ask(blender, "globe")
    ask(blender, "mug")
    assert {obj.name for obj in blender.context.selected_objects} == {"mug", "mug.001", "mug anchor", "mug anchor.001"}


def test_deleted_objects_are_reported_but_do_not_match(blender, loaded, capfd):
    ask(blender, "lemon")
    blender.ops.object.delete()
    assert ask(blender, "fruit") == {"FINISHED"}
    assert selected_ids(blender) == {2}
    assert [note.name for note in session(blender).notes] == ["Deleted: lemon"]
    capfd.readouterr()
    assert ask(blender, "citrus") == {"CANCELLED"}
    said = capfd.readouterr().out
    assert "Deleted: lemon" in said and "lemon," not in said
    assert blender.ops.r5dgs.select_object(object_id=4) == {"CANCELLED"}
    assert "lemon was deleted" in capfd.readouterr().out


def test_a_prompt_searches_the_active_scene_or_all_scenes(blender, loaded, tmp_path):
    path = scene_file.write(scenes.make_scene(n=200, objects=2), tmp_path / "other.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    other = next(c for c in blender.data.collections if c.r5dgs.is_scene and c != loaded)
    ask(blender, "mug")
    assert all(other.all_objects.get(obj.name) == obj for obj in blender.context.selected_objects)
    assert ask(blender, "globe") == {"CANCELLED"}
    blender.context.scene.r5dgs_words.all_scenes = True
    assert {match.scene for match in session(blender).matches} == {loaded.name}
    ask(blender, "mug")
    assert len(blender.context.selected_objects) == 4 and len(session(blender).matches) == 2
    blender.ops.r5dgs.select_object(scene=loaded.name, object_id=6)
    blender.context.scene.r5dgs_words.all_scenes = False
    assert ask(blender, "globe") == {"FINISHED"}


def test_selecting_can_be_undone_and_redone(blender, loaded):
    ask(blender, "globe")
    blender.ops.ed.undo_push(message="before")
    ask(blender, "mug")
    blender.ops.ed.undo_push(message="Select by Prompt")
    blender.ops.ed.undo()
    assert selected_ids(blender) == {6}
    blender.ops.ed.redo()
    assert selected_ids(blender) == {1} and blender.context.view_layer.objects.active.name == "mug anchor"


def test_selecting_an_object_by_its_id_can_be_undone_and_redone(blender, loaded):
    blender.ops.r5dgs.select_object(object_id=6)
    blender.ops.ed.undo_push(message="before")
    assert blender.ops.r5dgs.select_object(object_id=1, mode="ADD") == {"FINISHED"}
    blender.ops.ed.undo_push(message="Select Object")
    assert selected_ids(blender) == {1, 6}
    blender.ops.ed.undo()
    assert selected_ids(blender) == {6}
    blender.ops.ed.redo()
    assert selected_ids(blender) == {1, 6} and blender.context.view_layer.objects.active.name == "mug anchor"


@pytest.fixture
def meaningful(blender, tmp_path):
    """A loaded scene whose file stores an embedding of "sour thing", and the file."""
    bare = scenes.make_scene(n=200, objects=4)
    axes = np.eye(len(bare.objects), 8, dtype=np.float32)
    row = [item.id for item in bare.objects].index(4)
    rich = dataclasses.replace(
        bare.with_arrays(embeddings=axes, vocabulary_embeddings=axes[row : row + 1]), vocabulary=("sour thing",)
    )
    path = scene_file.write(rich, tmp_path / "meaningful.r5dgs")
    motions.load_again(blender, path)
    return path, rich


def test_stored_embeddings_match_phrases_that_no_name_contains(blender, meaningful):
    assert ask(blender, "sour things") == {"FINISHED"}
    assert selected_ids(blender) == {4} and "meaning of 'sour thing'" in session(blender).matches[0].why


def test_meanings_are_read_again_when_the_file_changes(blender, meaningful):
    path, rich = meaningful
    ask(blender, "sour things")
    scene_file.write(dataclasses.replace(rich, vocabulary=("a bitter thing",)), path)
    assert ask(blender, "sour things") == {"CANCELLED"}
    assert ask(blender, "bitter thing") == {"FINISHED"} and ask(blender, "lemon") == {"FINISHED"}


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"PK")])
def test_without_the_scene_file_only_names_are_searched_with_a_note(blender, meaningful, damage):
    damage(meaningful[0])
    assert ask(blender, "sour things") == {"CANCELLED"}
    assert ask(blender, "lemon") == {"FINISHED"}
    assert "by names only" in session(blender).notes[0].name


def test_without_a_scene_the_operators_cannot_be_called(blender):
    for operator in (blender.ops.r5dgs.select_by_prompt, blender.ops.r5dgs.preview):
        assert not operator.poll()


@pytest.mark.parametrize(
    ("text", "ids"),
    [
        ("everything", {1, 2, 3, 4, 5, 6}),
        ("not the mug", {2, 3, 4, 5, 6}),
        ("everything but the mug and fruit", {3, 5, 6}),
        ("fruit but not the lemon", {2}),
    ],
)
def test_everything_and_exclusions_select_the_expected_objects(blender, loaded, text, ids):
    assert ask(blender, text) == {"FINISHED"} and selected_ids(blender) == ids


def test_nothing_selects_nothing(blender, loaded):
    ask(blender, "mug")
    assert ask(blender, "nothing", "ADD") == {"FINISHED"} and selected_ids(blender) == {1}
    assert ask(blender, "none") == {"FINISHED"} and selected_ids(blender) == set()


@pytest.mark.parametrize("text", ["not the vaze", "everything but", "mug but not the vaze"])
def test_excluding_an_unknown_object_raises_and_selects_nothing(blender, loaded, text):
    ask(blender, "globe")
    with pytest.raises(RuntimeError, match="excludes an unknown object|nothing to exclude after"):
        ask(blender, text)
    assert selected_ids(blender) == {6} and len(session(blender).matches) == 0
    session(blender).prompt = text  # typed into the field, the panel says so
    assert any("exclude" in note.name for note in session(blender).notes)
    with pytest.raises(RuntimeError, match="excludes an unknown object|nothing to exclude after"):
        blender.ops.r5dgs.isolate(text=text)


def test_excluding_an_object_of_one_scene_selects_all_objects_of_the_other(blender, loaded, tmp_path):
    path = scene_file.write(scenes.make_scene(n=200, objects=2), tmp_path / "other.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    blender.context.scene.r5dgs_words.all_scenes = True
    ask(blender, "not the globe")
    found = {(match.scene == loaded.name, match.object_id) for match in session(blender).matches}
    assert found == {(True, number) for number in range(1, 6)} | {(False, 1), (False, 2)}


def test_everything_excludes_deleted_objects(blender, loaded):
    ask(blender, "lemon")
    blender.ops.object.delete()
    ask(blender, "everything")
    assert selected_ids(blender) == {1, 2, 3, 5, 6} and len(session(blender).notes) == 0

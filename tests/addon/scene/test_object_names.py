"""Names follow the user: a rename in the Outliner or in the sidebar applies everywhere."""

import importlib

import pytest

from r5dgs_core import errors
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

MUG, APPLE, CAR = 1, 2, 3


@pytest.fixture
def path(tmp_path):
    return scene_file.write(scenes.make_scene(n=300), tmp_path / "scene.r5dgs")


@pytest.fixture
def loaded(blender, path):
    return motions.load_again(blender, path)


@pytest.fixture
def table():
    return importlib.import_module("r5dgs.r5dgs_addon.scene.object_names")


def named(collection):
    return {data.name for data in [*collection.children_recursive, *collection.all_objects]}


def test_a_new_scene_has_the_files_names(loaded, table):
    expected = {-1: "unassigned", 0: "background", MUG: "mug", APPLE: "red apple", CAR: "toy car"}
    assert table.names(loaded) == expected
    assert [label.name for label in table.labels(loaded)] == [n for i, n in expected.items() if i >= 0]


@pytest.mark.parametrize(
    ("kind", "old", "new"),
    [("collections", "mug", "teapot"), ("objects", "mug anchor", "teapot anchor"), ("objects", "mug", "teapot")],
)
def test_renaming_the_collection_the_anchor_or_the_cloud_renames_the_object(blender, loaded, table, kind, old, new):
    getattr(blender.data, kind)[old].name = new
    assert table.names(loaded)[MUG] == "teapot"
    assert blender.ops.r5dgs.select_by_prompt(text="teapots") == {"FINISHED"}
    assert {obj.r5dgs.object_id for obj in blender.context.selected_objects} == {MUG}
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"CANCELLED"}


def test_a_name_that_another_file_data_has_counts_without_blenders_number(blender, loaded, table):
    blender.data.collections.new("teapot")
    blender.data.collections["mug"].name = "teapot"
    assert table.names(loaded)[MUG] == "teapot"


def test_objects_with_equal_names_are_distinguished(blender, loaded, table):
    blender.data.objects["mug anchor"].name = "red apple"
    assert table.names(loaded)[MUG] == "red apple 2" and table.names(loaded)[APPLE] == "red apple"


def test_a_duplicate_with_a_name_of_its_own_renames_nothing(blender, loaded, table):
    cloud = loaded.all_objects["mug"]
    copy = cloud.copy()
    cloud.users_collection[0].objects.link(copy)
    assert copy.name == "mug.001" and table.names(loaded)[MUG] == "mug"
    copy.name = "second"
    assert table.names(loaded)[MUG] == "mug"


def test_two_loads_of_a_file_keep_their_names_apart(blender, loaded, path, table):
    blender.ops.r5dgs.load_scene(filepath=str(path))
    first, second = (c for c in blender.data.collections if c.r5dgs.is_scene)
    assert table.names(first) == table.names(second)
    second.children[next(c.name for c in second.children if c.name.startswith("mug"))].name = "teapot"
    assert table.names(first)[MUG] == "mug" and table.names(second)[MUG] == "teapot"


def test_renaming_in_the_sidebar_takes_everything_along(blender, loaded, table):
    before = named(loaded)
    assert blender.ops.r5dgs.rename_object(object_id=MUG, new_name=" teapot ") == {"FINISHED"}
    assert table.names(loaded)[MUG] == loaded.r5dgs.table["teapot"].name
    assert named(loaded) == {name.replace("mug", "teapot") for name in before}
    assert {"teapot", "teapot anchor", "teapot shadow", "teapot shadow anchor"} <= named(loaded)


def test_renaming_twice_and_after_the_outliner_holds_too(blender, loaded, table):
    blender.data.objects["mug anchor"].name = "pot anchor"
    before = named(loaded)
    table.rename(loaded, MUG, "teapot")
    assert {"teapot", "teapot anchor", "teapot shadow"} <= named(loaded) and len(named(loaded)) == len(before)
    table.rename(loaded, MUG, "kettle")
    assert table.names(loaded)[MUG] == "kettle" and not any("pot" in name or "mug" in name for name in named(loaded))
    loaded.children["kettle"].name = "urn"
    assert table.names(loaded)[MUG] == "urn"


def test_a_name_that_is_taken_gets_a_number_and_none_is_refused(blender, loaded, table):
    assert table.rename(loaded, MUG, "red apple") == "red apple 2"
    assert blender.ops.r5dgs.rename_object(object_id=APPLE, new_name="red apple") == {"FINISHED"}
    assert table.names(loaded)[APPLE] == "red apple"
    with pytest.raises(errors.ConfigError, match="name"):
        table.rename(loaded, MUG, "  ")
    long = "ü" * 60
    assert table.rename(loaded, MUG, long) == "ü" * 31
    assert table.names(loaded)[MUG] == "ü" * 31


def test_the_collection_of_other_clouds_is_renamed_with_the_object(blender, loaded, table):
    table.rename(loaded, 0, "room")
    assert [child.name for child in loaded.children["room"].children] == ["room fringe"]


def test_a_name_inside_another_name_is_not_renamed(blender, loaded, table):
    table.rename(loaded, APPLE, "mug tall")
    table.rename(loaded, MUG, "cup")
    assert {"mug tall", "mug tall anchor", "cup", "cup shadow anchor"} <= named(loaded)
    assert table.names(loaded)[APPLE] == "mug tall"


def test_rows_of_the_list_rename_and_are_renamed(blender, loaded, table):
    entry = table.entry_of(loaded, MUG)
    assert entry.label == "mug"
    entry.label = "teapot"
    assert blender.data.objects["teapot anchor"].r5dgs.role == "ANCHOR" and entry.label == "teapot"
    entry.label = "  "
    assert entry.label == "teapot"
    blender.data.collections["teapot"].name = "urn"
    assert entry.label == "urn"


def test_the_name_of_one_object_equals_that_in_the_whole_table(blender, loaded, path, table):
    def agree():
        scenes = [c for c in blender.data.collections if c.r5dgs.is_scene]
        return all(table.name_of(e) == table.names(c)[e.object_id] for c in scenes for e in c.r5dgs.table)

    assert agree()
    blender.ops.r5dgs.load_scene(filepath=str(path))
    assert agree()
    blender.data.objects["mug anchor"].name = "red apple"
    assert agree() and table.names(loaded)[MUG] == "red apple 2"
    blender.data.collections["toy car"].name = "mug"
    assert agree()


def test_names_survive_saving_and_reloading(blender, loaded, table, tmp_path):
    blender.data.objects["mug"].name = "teapot"
    table.rename(loaded, APPLE, "plum")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    again = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    assert table.names(again)[MUG] == "teapot" and table.names(again)[APPLE] == "plum"
    again.children["plum"].name = "pear"
    assert table.names(again)[APPLE] == "pear"


def test_renaming_can_be_undone_and_redone(blender, loaded, table):
    blender.ops.ed.undo_push(message="before")
    names = named(loaded)
    blender.ops.r5dgs.rename_object(object_id=MUG, new_name="teapot")
    blender.ops.ed.undo_push(message="Rename Object")
    blender.ops.ed.undo()
    again = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    assert table.names(again)[MUG] == "mug" and named(again) == names
    blender.ops.ed.redo()
    again = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    assert table.names(again)[MUG] == "teapot" and "teapot anchor" in named(again)


def test_aliases_come_and_go_and_find_the_object(blender, loaded, table):
    blender.context.view_layer.objects.active = blender.data.objects["toy car"]
    assert blender.ops.r5dgs.add_alias(word=" lorry ") == {"FINISHED"}
    assert blender.ops.r5dgs.add_alias(word="lorry") == {"CANCELLED"}
    assert blender.ops.r5dgs.add_alias(word="  ") == {"CANCELLED"}
    assert blender.ops.r5dgs.select_by_prompt(text="lorries") == {"FINISHED"}
    assert {obj.r5dgs.object_id for obj in blender.context.selected_objects} == {CAR}
    blender.ops.ed.undo_push(message="before")
    assert blender.ops.r5dgs.remove_alias(word="vehicle", object_id=CAR) == {"FINISHED"}
    assert blender.ops.r5dgs.remove_alias(word="vehicle", object_id=CAR) == {"CANCELLED"}
    blender.ops.ed.undo_push(message="Remove Alias")

    def words():
        scene = next(c for c in blender.data.collections if c.r5dgs.is_scene)
        return [alias.name for alias in table.entry_of(scene, CAR).aliases]

    assert words() == ["racer", "lorry"]
    blender.ops.ed.undo()
    assert words() == ["vehicle", "racer", "lorry"]
    blender.ops.ed.redo()
    assert words() == ["racer", "lorry"]


def test_adding_and_removing_an_alias_can_be_undone_and_redone(blender, loaded, table):
    def words():  # undoing may give all data new places in memory
        collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
        return [alias.name for alias in table.entry_of(collection, CAR).aliases]

    blender.ops.ed.undo_push(message="before")
    states = [words()]
    for call in (blender.ops.r5dgs.add_alias, blender.ops.r5dgs.remove_alias):
        assert call(word="lorry", object_id=CAR) == {"FINISHED"}
        blender.ops.ed.undo_push(message="alias")
        states.append(words())
    assert states == [states[0], [*states[0], "lorry"], states[0]]
    for expected in (states[1], states[0]):
        blender.ops.ed.undo()
        assert words() == expected
    blender.ops.ed.redo()
    assert words() == states[1]

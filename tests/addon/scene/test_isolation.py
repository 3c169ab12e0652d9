"""Isolating hides all but some objects of loaded scenes and can be undone exactly."""

import pytest

from r5dgs_core.scene import scene_file
from tests.support import motions, scenes


@pytest.fixture
def load(blender, tmp_path):
    def load(name):
        path = scene_file.write(scenes.make_scene(n=200), tmp_path / f"{name}.r5dgs")
        motions.load_again(blender, path)

    load("first")
    return load


def shown(bpy):
    """Everything's eye and camera."""
    return {obj.name: (obj.hide_get(), obj.hide_render) for obj in bpy.context.scene.objects}


def visible_clouds(bpy):
    return {obj.name for obj in bpy.context.scene.objects if obj.r5dgs.role == "CLOUD" and obj.visible_get()}


def test_only_the_named_objects_stay_and_the_rest_of_the_file_too(blender, load):
    before = shown(blender)
    assert blender.ops.r5dgs.isolate(text="mug and car") == {"FINISHED"}
    assert visible_clouds(blender) == {"mug", "toy car"}
    after = shown(blender)
    assert after["Cube"] == before["Cube"] and not after["Camera"][0] and not after["mug anchor"][0]
    assert after["red apple"] == (True, True) and after["red apple anchor"][0]
    assert blender.ops.r5dgs.unisolate() == {"FINISHED"}
    assert shown(blender) == before


def test_unisolating_restores_hidden_objects(blender, load):
    blender.data.objects["mug"].hide_set(True)
    blender.data.objects["red apple"].hide_render = True
    blender.data.objects["toy car anchor"].hide_set(True)
    before = shown(blender)
    blender.ops.r5dgs.isolate(text="mug")
    assert visible_clouds(blender) == {"mug"}
    blender.ops.r5dgs.isolate(text="apple")
    assert visible_clouds(blender) == {"red apple"} and not blender.data.objects["red apple"].hide_render
    blender.ops.r5dgs.unisolate()
    assert shown(blender) == before
    assert not blender.ops.r5dgs.unisolate.poll()


def test_all_loaded_scenes_are_hidden_but_the_selected_objects(blender, load):
    load("second")
    before = shown(blender)
    blender.ops.r5dgs.select_by_prompt(text="mug")
    mine = {obj.name for obj in blender.context.selected_objects if obj.r5dgs.role == "CLOUD"}
    assert blender.ops.r5dgs.isolate() == {"FINISHED"}
    assert visible_clouds(blender) == mine and len(mine) == 1
    blender.ops.r5dgs.unisolate()
    assert shown(blender) == before


def test_isolation_survives_saving_renaming_and_deleting(blender, load, tmp_path):
    blender.data.objects["toy car"].hide_set(True)
    before = shown(blender)
    blender.ops.r5dgs.isolate(text="mug")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert visible_clouds(blender) == {"mug"}
    blender.data.objects["red apple"].name = "plum"
    blender.data.objects.remove(blender.data.objects["red apple anchor"])
    assert blender.ops.r5dgs.unisolate() == {"FINISHED"}
    before["plum"] = before.pop("red apple")
    del before["red apple anchor"]
    assert shown(blender) == before


def test_isolating_no_object_is_cancelled_and_changes_nothing(blender, load):
    before = shown(blender)
    assert blender.ops.r5dgs.isolate(text="submarine") == {"CANCELLED"}
    for obj in blender.context.selected_objects:
        obj.select_set(False)
    assert blender.ops.r5dgs.isolate() == {"CANCELLED"}
    assert blender.ops.r5dgs.isolate(object_id=77) == {"CANCELLED"}
    assert shown(blender) == before and not blender.ops.r5dgs.unisolate.poll()


def test_isolating_and_going_back_can_be_undone_and_redone(blender, load):
    blender.ops.ed.undo_push(message="before")
    before = shown(blender)
    blender.ops.r5dgs.isolate(text="mug")
    blender.ops.ed.undo_push(message="Isolate")
    isolated = shown(blender)
    blender.ops.r5dgs.unisolate()
    blender.ops.ed.undo_push(message="Un-Isolate")
    blender.ops.ed.undo()
    assert shown(blender) == isolated and blender.ops.r5dgs.unisolate.poll()
    blender.ops.ed.undo()
    assert shown(blender) == before and not blender.ops.r5dgs.unisolate.poll()
    blender.ops.ed.redo()
    assert shown(blender) == isolated
    blender.ops.r5dgs.unisolate()
    assert shown(blender) == before

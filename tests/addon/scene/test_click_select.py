"""A click on a cloud in a 3D view selects its anchor; other changes of the active object do not."""

import importlib
from types import SimpleNamespace

import pytest

from r5dgs_core.scene import scene_file
from tests.support import motions, scenes


@pytest.fixture
def click(blender, tmp_path):
    path = scene_file.write(scenes.make_scene(n=200), tmp_path / "scene.r5dgs")
    motions.load_again(blender, path)
    return importlib.import_module("r5dgs.r5dgs_addon.scene.click_select")


def selected(bpy):
    return {obj.name for obj in bpy.context.selected_objects}


def choose(bpy, name, extend=False):
    """Select an object like a click in Blender."""
    if not extend:
        for obj in bpy.context.selected_objects:
            obj.select_set(False)
    bpy.data.objects[name].select_set(True)
    bpy.context.view_layer.objects.active = bpy.data.objects[name]


def test_the_anchor_replaces_its_cloud_in_the_selection(blender, click):
    choose(blender, "mug")
    assert click.follow(blender.context, extend=False).name == "mug anchor"
    assert selected(blender) == {"mug anchor"}
    assert blender.context.view_layer.objects.active.name == "mug anchor"


def test_shift_adds_anchors_makes_them_active_and_takes_the_active_one_out(blender, click, monkeypatch):
    def shift_click(name):
        choose(blender, name, extend=True)
        heard(monkeypatch, blender, click, "VIEW3D_OT_select", toggle=True)
        return selected(blender), blender.context.view_layer.objects.active.name

    choose(blender, "mug")
    heard(monkeypatch, blender, click, "VIEW3D_OT_select")
    both = {"mug anchor", "toy car anchor"}
    assert shift_click("toy car") == (both, "toy car anchor")
    assert shift_click("mug") == (both, "mug anchor")
    assert shift_click("mug") == ({"toy car anchor"}, "mug anchor")
    assert shift_click("mug") == (both, "mug anchor")


@pytest.mark.parametrize("name", ["Cube", "mug anchor"])
def test_objects_that_are_not_clouds_stay_selected(blender, click, name):
    choose(blender, name)
    assert click.follow(blender.context, extend=False) is None and selected(blender) == {name}


def test_a_cloud_whose_anchor_cannot_be_selected_stays_selected(blender, click):
    blender.data.objects["mug anchor"].hide_set(True)
    blender.data.objects["toy car anchor"].hide_select = True
    blender.data.objects["red apple"].parent = None
    for name in ("mug", "toy car", "red apple"):
        choose(blender, name)
        assert click.follow(blender.context, extend=False) is None and selected(blender) == {name}


def heard(monkeypatch, bpy, click, operator, **properties):
    """Send the notification as if after an operator; without a window, the real list of operators is empty."""
    done = [
        SimpleNamespace(
            bl_idname=operator, properties=SimpleNamespace(**{"extend": False, "toggle": False} | properties)
        )
    ]
    context = SimpleNamespace(
        scene=bpy.context.scene,
        mode=bpy.context.mode,
        view_layer=bpy.context.view_layer,
        selected_objects=bpy.context.selected_objects,
        window_manager=SimpleNamespace(operators=done),
    )
    with monkeypatch.context() as patch:
        patch.setattr(click, "bpy", SimpleNamespace(context=context, ops=bpy.ops))
        click._when_active_changes()


def test_only_a_click_in_a_view_is_followed(blender, click, monkeypatch):
    choose(blender, "mug")
    heard(monkeypatch, blender, click, "OUTLINER_OT_item_activate")
    assert selected(blender) == {"mug"}
    heard(monkeypatch, blender, click, "VIEW3D_OT_select")
    assert selected(blender) == {"mug anchor"}
    choose(blender, "toy car", extend=True)
    heard(monkeypatch, blender, click, "VIEW3D_OT_select", toggle=True)
    assert selected(blender) == {"mug anchor", "toy car anchor"}


def test_click_selection_can_be_switched_off(blender, click, monkeypatch):
    blender.context.scene.r5dgs_words.click_selects_anchor = False
    choose(blender, "mug")
    heard(monkeypatch, blender, click, "VIEW3D_OT_select")
    assert selected(blender) == {"mug"}


def test_it_can_be_undone(blender, click, monkeypatch):
    choose(blender, "Cube")
    blender.ops.ed.undo_push(message="before")
    choose(blender, "mug")
    blender.ops.ed.undo_push(message="Select")  # as Blender's own click
    heard(monkeypatch, blender, click, "VIEW3D_OT_select")
    choose(blender, "Cube")
    blender.ops.ed.undo_push(message="Select")
    blender.ops.ed.undo()
    assert selected(blender) == {"mug anchor"}


def test_clicks_are_followed_in_each_file_until_unregistering(blender, extension, click):
    handlers = blender.app.handlers.load_post
    assert handlers.count(click._after_load) == 1
    blender.ops.wm.read_homefile(app_template="")
    assert handlers.count(click._after_load) == 1
    extension.unregister()
    try:
        assert click._after_load not in handlers
    finally:
        extension.register()
    assert handlers.count(click._after_load) == 1

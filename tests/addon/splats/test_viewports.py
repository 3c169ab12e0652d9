"""Handler of the viewports: what it keeps, what it releases, and what render threads may not touch."""

import threading
from types import SimpleNamespace

import pytest

from r5dgs_core.scene import scene_file
from tests.support import motions, scenes


@pytest.fixture
def splats(blender):
    module = motions.addon("splats.viewport_splats")
    yield module
    module._state.forget()
    if blender.app.timers.is_registered(module._show_points):
        blender.app.timers.unregister(module._show_points)


@pytest.fixture
def visible(splats):
    return motions.addon("splats.visible_splats")


def viewport(bpy, address, regions=()):
    """Context of a viewport whose region has an address, in a window with regions of other addresses."""
    region = SimpleNamespace(as_pointer=lambda: address, width=4, height=4)
    others = [SimpleNamespace(as_pointer=lambda one=one: one) for one in regions]
    area = SimpleNamespace(type="VIEW_3D", regions=others)
    manager = SimpleNamespace(windows=[SimpleNamespace(screen=SimpleNamespace(areas=[area]))])
    space = SimpleNamespace(shading=SimpleNamespace(type="SOLID"))
    return SimpleNamespace(
        region=region,
        region_data=SimpleNamespace(),
        space_data=space,
        scene=bpy.context.scene,
        view_layer=bpy.context.view_layer,
        window_manager=manager,
        evaluated_depsgraph_get=bpy.context.evaluated_depsgraph_get,
    )


@pytest.fixture
def collection(blender, tmp_path):
    return motions.load_again(blender, scene_file.write(scenes.make_scene(n=100), tmp_path / "scene.r5dgs"))


def filled(bpy, visible, collection):
    """A view layer with the points of a loaded scene; its key."""
    key = visible.layer_key(bpy.context.scene, bpy.context.view_layer)
    uids = [cloud.session_uid for cloud in motions.clouds(collection)]
    layer = visible._layers[key] = visible._Layer(dict.fromkeys(uids), (tuple((uid, 0, 0) for uid in uids), object()))
    return layer, uids


def test_a_thread_changes_nothing_until_a_viewport_is_drawn(blender, splats, visible, collection):
    visible.catch_up()
    layer, uids = filled(blender, visible, collection)
    cloud = blender.data.objects[motions.clouds(collection)[0].name]
    updates = [SimpleNamespace(id=SimpleNamespace(original=cloud), is_updated_geometry=True)]
    table = layer.table
    for mode in ("RENDER", "VIEWPORT"):
        depsgraph = SimpleNamespace(mode=mode, updates=updates)
        thread = threading.Thread(target=splats._follow_changes, args=(None, depsgraph))
        thread.start()
        thread.join()
        assert layer.table is table and set(layer.clouds) == set(uids)
    visible.catch_up()
    assert layer.changed == {cloud.session_uid} and layer.table is table and set(layer.clouds) == set(uids)


def test_rendering_an_animation_does_not_disturb_the_viewports(blender, splats, visible, collection, tmp_path):
    visible.catch_up()
    layer, uids = filled(blender, visible, collection)
    table, scene = layer.table, blender.context.scene
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 2, str(tmp_path / "picture")
    visible._changes.clear()
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.resolution_x = scene.render.resolution_y = 4
    count = []
    blender.app.handlers.render_post.append(lambda *_: count.append((layer.table, len(layer.clouds))))
    blender.ops.render.render(animation=True)
    blender.app.handlers.render_post.pop()
    assert count == [(table, len(uids))] * 2


def test_points_of_deleted_objects_and_other_layers_are_released(blender, visible, collection):
    visible.catch_up()
    layer, uids = filled(blender, visible, collection)
    visible._layers[(-1, "Deleted")] = visible._Layer()
    cloud = motions.clouds(collection)[0]
    gone = cloud.session_uid
    blender.data.objects.remove(cloud)
    visible.queue_change(())
    visible.catch_up()
    assert list(visible._layers.values()) == [layer] and set(layer.clouds) == set(uids) - {gone}
    assert layer.table is None
    visible.queue_reload()
    visible.catch_up()
    assert not visible._layers


def test_lost_changes_are_made_up_for(blender, visible, collection):
    visible.catch_up()
    filled(blender, visible, collection)
    for _ in range(visible._changes.maxlen + 5):
        visible.queue_change(())
    visible.catch_up()
    assert not visible._layers and not visible._changes


def test_pictures_of_closed_viewports_are_released(blender, splats):
    splats._state.pictures = {address: splats._Picture() for address in (1, 2, 3, 4)}
    splats._drop_closed(viewport(blender, 1, (2, 4)))
    assert set(splats._state.pictures) == {1, 2, 4}


def test_a_viewport_without_splats_keeps_no_picture(blender, splats, collection):
    blender.ops.r5dgs.set_display(display="POINTS")
    splats._state.pictures = {1: splats._Picture(), 2: splats._Picture()}
    splats._draw_viewport(viewport(blender, 1, (1, 2)))
    assert set(splats._state.pictures) == {2}


def test_points_are_shown_where_no_shader_compiles_also_later(blender, splats, visible, collection, monkeypatch):
    def fails(*_):
        raise motions.addon("splats.shaders").CompileError("no such function")

    monkeypatch.setattr(visible, "shown", fails)
    context = viewport(blender, 1)
    for _ in range(2):  # the second time the user asks for splats again
        splats._draw_viewport(context)
        assert blender.app.timers.is_registered(splats._show_points)
        blender.app.timers.unregister(splats._show_points)
        splats._show_points()  # timers do not run in background mode
        assert collection.r5dgs.display == "POINTS"
        assert not any(cloud.modifiers for cloud in motions.clouds(collection))
        assert "cannot draw splats: no such function" in splats.message(blender.context)
        blender.ops.r5dgs.set_display(display="SPLATS")
    splats._state.forget()
    assert not splats.message(blender.context)


def test_another_error_is_said_for_its_view_layer_only_and_goes_away(
    blender, splats, visible, collection, monkeypatch, capsys
):
    monkeypatch.setattr(visible, "shown", lambda *_: 1 / 0)
    other = blender.data.scenes.new("other")
    context = viewport(blender, 1)
    elsewhere = SimpleNamespace(**{**vars(context), "scene": other, "view_layer": other.view_layers[0]})
    for _ in range(3):
        splats._draw_viewport(context)
    assert "Splats could not be drawn: ZeroDivisionError" in splats.message(context)
    assert capsys.readouterr().err.count("Traceback") == 1
    assert not splats.message(elsewhere) and collection.r5dgs.display == "SPLATS"
    monkeypatch.setattr(visible, "shown", lambda *_: None)
    splats._draw_viewport(elsewhere)
    assert splats.message(context)
    splats._draw_viewport(context)
    assert not splats.message(context)

"""The life of a session: files that move, scenes that are appended, linked, loaded twice, or loaded in odd places."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.scene import scene_file
from tests.addon import conftest
from tests.support import layouts, motions, registrations, scenes

KINDS = ("collections", "objects", "pointclouds", "actions", "materials", "node_groups", "scenes")


@pytest.fixture
def scene_path(tmp_path):
    folder = tmp_path / "captured"
    folder.mkdir()
    return scene_file.write(scenes.make_scene(n=300, objects=3, seed=1), folder / "synthetic.r5dgs")


def loaded(bpy):
    (collection,) = (
        c for c in bpy.data.collections if c.r5dgs.is_scene and c in bpy.context.scene.collection.children[:]
    )
    return collection


def plays(bpy, collection, path):
    """True if every point of a loaded scene is at its position in the core."""
    scene = scene_file.read(path)
    found = [motions.offsets(bpy, collection, scene, t) for t in (0.0, 0.333, scenes.T_MAX, 0.9)]
    return bool((np.array(found) <= motions.POSITION_TOLERANCE).all())


def draw_panels(bpy):
    classes = [cls for module in motions.addon("panels").MODULES for cls in module.CLASSES]
    return layouts.draw(bpy, *(cls for cls in classes if issubclass(cls, bpy.types.Panel)))


def contents(bpy):
    return {kind: {data.session_uid for data in getattr(bpy.data, kind)} for kind in KINDS}


@pytest.fixture
def library(blender, scene_path, tmp_path):
    """A .blend in a folder of its own that holds the loaded scene; an empty file is open."""
    blend = tmp_path / "library" / "library.blend"
    blend.parent.mkdir()
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    motions.load_again(blender, scene_path)
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    return blend


def bring(bpy, blend, *, link):
    with bpy.data.libraries.load(str(blend), link=link) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    (collection,) = target.collections
    bpy.context.scene.collection.children.link(collection)
    return collection


# --- files that move ---


def test_a_blend_and_its_scene_can_move_together(blender, scene_path, tmp_path):
    motions.load(blender, scene_path)
    blender.ops.wm.save_as_mainfile(filepath=str(scene_path.parent / "work.blend"))
    moved = tmp_path / "elsewhere" / "far"
    moved.parent.mkdir()
    blender.ops.wm.read_homefile(app_template="")
    shutil.move(scene_path.parent, moved)
    blender.ops.wm.open_mainfile(filepath=str(moved / "work.blend"))
    assert (
        motions.addon("engine.render_request").scene_path(loaded(blender)).resolve()
        == (moved / "synthetic.r5dgs").resolve()
    )
    assert plays(blender, loaded(blender), moved / "synthetic.r5dgs")


def test_a_lost_scene_file_raises_by_name_until_the_user_sets_its_path(blender, scene_path, tmp_path):
    collection = motions.load(blender, scene_path)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    hidden = tmp_path / "hidden" / "renamed.r5dgs"
    hidden.parent.mkdir()
    scene_path.rename(hidden)
    with pytest.raises(errors.SceneFileError, match="synthetic.r5dgs.*'Scene File'"):
        motions.addon("engine.render_request").scene_path(collection)
    assert plays(blender, collection, hidden)  # which needs no file
    blender.ops.wm.save_mainfile()  # the stored path does not change
    assert collection.r5dgs.filepath == "//captured/synthetic.r5dgs"
    collection.r5dgs.filepath = "//hidden/renamed.r5dgs"
    assert motions.addon("engine.render_request").scene_path(collection).resolve() == hidden.resolve()


# --- append, link, override ---


def test_an_appended_scene_plays_and_finds_its_file_from_another_folder(blender, library, scene_path, tmp_path):
    blend = tmp_path / "a" / "b" / "new.blend"
    blend.parent.mkdir(parents=True)
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    collection = bring(blender, library, link=False)
    assert collection.library is None and collection.r5dgs.root in collection.objects[:]
    assert plays(blender, collection, scene_path)
    assert motions.addon("engine.render_request").scene_path(collection).resolve() == scene_path.resolve()
    blender.ops.wm.save_mainfile()  # from here on by the new .blend's own relative path
    assert collection.r5dgs.filepath == "//../../captured/synthetic.r5dgs"
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    assert "synthetic: 3 objects, 300 Gaussians" in draw_panels(blender)


def test_a_linked_scene_plays_and_nothing_is_written_to_it(blender, library, scene_path, tmp_path):
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "linking.blend"))
    collection = bring(blender, library, link=True)
    before = library.read_bytes(), collection.r5dgs.filepath, collection.r5dgs.seen_at
    assert collection.library is not None and plays(blender, collection, scene_path)
    assert motions.addon("engine.render_request").scene_path(collection).resolve() == scene_path.resolve()
    assert "synthetic: 3 objects, 300 Gaussians" in draw_panels(blender)
    with pytest.raises(RuntimeError, match="linked from another file"):
        blender.ops.r5dgs.set_display(display="ELLIPSOIDS")
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    blender.ops.wm.save_mainfile()
    assert (library.read_bytes(), collection.r5dgs.filepath, collection.r5dgs.seen_at) == before
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "linking.blend"))
    assert plays(blender, loaded(blender), scene_path)


def test_an_override_of_a_linked_scene_can_be_moved_and_still_plays(blender, library, scene_path, tmp_path):
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "overriding.blend"))
    linked = bring(blender, library, link=True)
    override = linked.override_hierarchy_create(
        blender.context.scene, blender.context.view_layer, do_fully_editable=True
    )
    if linked in blender.context.scene.collection.children[:]:
        blender.context.scene.collection.children.unlink(linked)
    assert override.r5dgs.is_scene and override.override_library is not None
    assert plays(blender, override, scene_path)
    assert motions.addon("engine.render_request").scene_path(override).resolve() == scene_path.resolve()
    assert "synthetic: 3 objects, 300 Gaussians" in draw_panels(blender)
    root = next(obj for obj in override.all_objects if obj.r5dgs.role == "ROOT")
    assert root.library is None
    root.location = (0, 0, 2)
    blender.ops.wm.save_mainfile()
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "overriding.blend"))
    again = loaded(blender)
    assert not plays(blender, again, scene_path)  # it stands higher
    next(obj for obj in again.all_objects if obj.r5dgs.role == "ROOT").location = (0, 0, 0)
    assert plays(blender, again, scene_path)
    assert motions.addon("engine.render_request").scene_path(again).resolve() == scene_path.resolve()


def linked_as_instance(bpy, blend):
    """File > Link, which instances the collection by an empty; both."""
    name = next(iter(names_in(bpy, blend)))
    bpy.ops.wm.link(filepath=f"{blend}/Collection/{name}", directory=f"{blend}/Collection/", filename=name)
    (empty,) = (obj for obj in bpy.context.scene.objects if obj.instance_type == "COLLECTION")
    return empty.instance_collection, empty


def names_in(bpy, blend):
    with bpy.data.libraries.load(str(blend), link=True) as (source, _):
        return [name for name in source.collections if name.startswith("R5DGS")]


def test_a_prompt_finds_an_instanced_scene_and_selects_what_instances_it(blender, library, scene_path):
    collection, empty = linked_as_instance(blender, library)
    assert collection.library is not None and collection not in blender.context.scene.collection.children_recursive
    empty.select_set(False)
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    assert blender.context.selected_objects == [empty] == [blender.context.view_layer.objects.active]
    session = blender.context.window_manager.r5dgs_words
    assert [match.name for match in session.matches] == ["mug"]
    assert [note.name for note in session.notes] == [
        f"{collection.name} is instanced by {empty.name}; its objects cannot be selected one by one"
    ]
    assert blender.ops.r5dgs.select_object(object_id=1, mode="SUBTRACT") == {"FINISHED"} and not empty.select_get()
    assert "synthetic: 3 objects, 300 Gaussians" in draw_panels(blender)
    empty.hide_set(True)
    assert blender.ops.r5dgs.select_by_prompt(text="everything") == {"FINISHED"}
    assert not blender.context.selected_objects


def test_an_instance_in_an_instance_is_found_too(blender, library):
    collection, empty = linked_as_instance(blender, library)
    inner = blender.data.collections.new("inner")
    blender.context.scene.collection.objects.unlink(empty)
    inner.objects.link(empty)
    outer = blender.data.objects.new("outer", None)
    outer.instance_type, outer.instance_collection = "COLLECTION", inner
    blender.context.scene.collection.objects.link(outer)
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    assert blender.context.selected_objects == [outer]


def test_an_override_is_selected_by_words(blender, library):
    linked = bring(blender, library, link=True)
    override = linked.override_hierarchy_create(
        blender.context.scene, blender.context.view_layer, do_fully_editable=True
    )
    if linked in blender.context.scene.collection.children[:]:
        blender.context.scene.collection.children.unlink(linked)
    blender.context.view_layer.update()
    assert blender.ops.r5dgs.select_by_prompt(text="mug") == {"FINISHED"}
    assert {obj.name for obj in blender.context.selected_objects} == {"mug", "mug anchor"}
    assert all(override.all_objects.get(obj.name) == obj for obj in blender.context.selected_objects)


@pytest.mark.parametrize("how", ["append", "link", "instance"])
def test_an_appended_or_linked_scene_offers_its_frames_and_marker(blender, library, how):
    if how == "instance":
        collection, _ = linked_as_instance(blender, library)
    else:
        collection = bring(blender, library, link=how == "link")
    shown = blender.context.scene
    assert "r5dgs.fit_timeline" in draw_panels(blender) and len(shown.timeline_markers) == 0
    assert blender.ops.r5dgs.fit_timeline() == {"FINISHED"}
    times = motions.addon("scene.timeline").of_collection(collection)
    assert (shown.frame_start, shown.frame_end) == (1, round(times.frame(times.t_end)))
    assert [marker.frame for marker in shown.timeline_markers] == [round(times.frame(times.t_max))]
    assert "r5dgs.fit_timeline" not in draw_panels(blender)


# --- several scenes, odd places ---


def test_two_scenes_at_once_have_names_of_their_own_and_both_play(blender, scene_path, tmp_path):
    other = scene_file.write(scenes.make_scene(n=200, objects=2, seed=7), tmp_path / "other.r5dgs")
    first = motions.load(blender, scene_path)
    second = motions.load(blender, other, frame_zero=31.5)
    third = motions.load(blender, scene_path, display="ELLIPSOIDS")
    names = [obj.name for collection in (first, second, third) for obj in collection.all_objects]
    assert len(names) == len(set(names))
    assert plays(blender, first, scene_path) and plays(blender, second, other)
    loaded_scenes = motions.addon("scene.loaded_scenes")
    for collection in (first, second, third):
        blender.context.view_layer.objects.active = loaded_scenes.members(collection, "CLOUD")[0]
        assert loaded_scenes.active_collection(blender.context) == collection
    blender.ops.r5dgs.set_display(display="POINTS")
    assert third.r5dgs.display == "POINTS" and plays(blender, third, scene_path)


@pytest.mark.parametrize("fps", [24, 60, 120])
def test_frames_map_to_times_at_any_frame_rate(blender, scene_path, fps):
    blender.context.scene.render.fps = fps
    assert plays(blender, motions.load(blender, scene_path), scene_path)


def test_loading_in_edit_mode_raises_and_changes_nothing(blender, scene_path):
    blender.context.view_layer.objects.active = blender.data.objects["Cube"]
    blender.ops.object.mode_set(mode="EDIT")
    before = contents(blender)
    with pytest.raises(RuntimeError, match="Switch to Object Mode first"):
        blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    assert contents(blender) == before and blender.context.mode == "EDIT_MESH"
    blender.ops.object.mode_set(mode="OBJECT")


def test_an_excluded_or_hidden_active_collection_does_not_swallow_the_scene(blender, scene_path):
    hidden = blender.data.collections.new("hidden")
    blender.context.scene.collection.children.link(hidden)
    layer = blender.context.view_layer
    layer.active_layer_collection = layer.layer_collection.children["hidden"]
    layer.layer_collection.children["hidden"].exclude = True
    collection = motions.load(blender, scene_path)
    assert all(obj.visible_get() for obj in collection.all_objects if obj.type != "CAMERA")  # these are hidden
    assert plays(blender, collection, scene_path)


def test_a_scene_is_loaded_into_the_scene_of_the_context_only(blender, scene_path):
    empty = blender.data.scenes.new("empty")
    with blender.context.temp_override(scene=empty, view_layer=empty.view_layers[0]):
        collection = motions.load(blender, scene_path)
    assert collection in empty.collection.children[:]
    assert collection not in blender.context.window.scene.collection.children[:]


def test_a_linked_scene_is_not_loaded_into(blender, scene_path, tmp_path):
    blender.data.scenes.new("theirs")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "theirs.blend"))
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    with blender.data.libraries.load(str(tmp_path / "theirs.blend"), link=True) as (_, target):
        target.scenes = ["theirs"]
    theirs, before = target.scenes[0], contents(blender)
    with (
        blender.context.temp_override(scene=theirs, view_layer=theirs.view_layers[0]),
        pytest.raises(RuntimeError, match="linked from another file"),
    ):
        blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    assert contents(blender) == before


# --- after the extension is removed ---


def test_unregistering_leaves_nothing_and_registering_again_brings_all_back(blender, extension, scene_path):
    present = registrations.traces(blender)
    assert {"R5DGS_OT_load_scene", "R5DGS_PT_scene", "R5DGS_FH_scene", "Object.r5dgs"} <= present
    assert any(name.startswith("TOPBAR_MT_file_import") for name in present)
    for _ in range(2):
        extension.unregister()
        try:
            assert registrations.traces(blender) == set()
        finally:
            extension.register()
        assert {name.split(" at 0x")[0] for name in registrations.traces(blender)} == {
            name.split(" at 0x")[0] for name in present
        }
    assert plays(blender, motions.load(blender, scene_path), scene_path)


def test_a_script_that_uses_the_module_ends_normally(blender, scene_path):
    if blender.app.binary_path:
        pytest.skip("Blender's Python has no module bpy outside of Blender")
    lines = (
        "import sys",
        f"sys.path.insert(0, {str(conftest.ROOT)!r})",
        "from tests.addon import conftest",
        "conftest.load_extension().register()",
        "import bpy",
        f"assert bpy.ops.r5dgs.load_scene(filepath={str(scene_path)!r}) == {{'FINISHED'}}",
        "assert bpy.ops.r5dgs.select_by_prompt(text='mug', mode='SET') == {'FINISHED'}",
    )
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_loaded_scenes_survive_disabling_and_enabling_the_extension(blender, extension, scene_path):
    motions.load(blender, scene_path)
    before = {obj.name for obj in blender.data.objects}
    extension.unregister()
    try:
        blender.context.scene.frame_set(20)
        first = np.array(blender.data.objects["mug anchor"].matrix_world)
        blender.context.scene.frame_set(50)
        assert not np.allclose(np.array(blender.data.objects["mug anchor"].matrix_world), first)
    finally:
        extension.register()
    assert {obj.name for obj in blender.data.objects} == before
    assert plays(blender, loaded(blender), scene_path)


def radii(bpy, name="mug"):
    """Radii with which a viewport shows the points of a cloud."""
    cloud = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {point.radius for point in cloud.data.points}


def test_points_are_visible_while_the_extension_is_disabled(blender, extension, scene_path):
    motions.load(blender, scene_path)
    assert radii(blender) == {0.0}
    extension.unregister()
    try:
        assert min(radii(blender)) > 0
    finally:
        extension.register()
    assert radii(blender) == {0.0}


@pytest.mark.parametrize("copy", [False, True])
def test_a_blend_opened_without_the_extension_shows_points(blender, extension, scene_path, tmp_path, copy):
    motions.load(blender, scene_path)
    blend = str(tmp_path / "shared.blend")
    blender.ops.wm.save_as_mainfile(filepath=blend, copy=copy)
    assert radii(blender) == {0.0}, "saving changed the open file"
    extension.unregister()
    try:
        blender.ops.wm.open_mainfile(filepath=blend)
        assert min(radii(blender)) > 0
    finally:
        extension.register()
    blender.ops.wm.open_mainfile(filepath=blend)
    assert radii(blender) == {0.0}


@pytest.mark.parametrize("link", [False, True])
def test_imported_scenes_hide_their_points_too(blender, library, link):
    bring(blender, library, link=link)
    blender.context.view_layer.update()
    assert radii(blender) == {0.0}


def test_a_cloud_without_its_scene_is_visible(blender, library):
    with blender.data.libraries.load(str(library)) as (_, target):
        target.objects = ["mug"]
    blender.context.scene.collection.objects.link(target.objects[0])
    root = target.objects[0].parent.parent
    assert root.r5dgs.role == "ROOT"
    blender.context.view_layer.update()
    assert min(radii(blender)) > 0

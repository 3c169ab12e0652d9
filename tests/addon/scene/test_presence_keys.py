"""Objects that enter late or leave are hidden by keys while they are absent, whatever users do with them."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.formats import ply
from r5dgs_core.playback import played_splats, scene_player
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

ABSENT = ((-np.inf, 0.123), (0.32, 0.45))
THERE = {-0.01: False, 0.0: False, 0.11: False, 0.13: True, 0.33: False, 0.44: False, 0.46: True, 0.9: True}
OWN = {"mug", "mug shadow"}


@pytest.fixture
def scene(tmp_path):
    made = scenes.with_absence(scenes.make_scene(n=300, seed=4), *ABSENT)
    return scene_file.read(scene_file.write(made, tmp_path / "scene.r5dgs"))


@pytest.fixture
def loaded(blender, scene, tmp_path):
    return motions.load_again(blender, tmp_path / "scene.r5dgs")


def drawn(bpy):
    """Names of the point clouds that a picture shows at the current frame."""
    graph = bpy.context.evaluated_depsgraph_get()
    _, found = motions.addon("engine.visible_clouds").instances(graph)
    return {one.object.name for one in found}


def in_renders(bpy):
    return {obj.name for obj in bpy.data.objects if obj.r5dgs.role == "CLOUD" and not obj.hide_render}


def assert_there(bpy, collection, expected=THERE, own=OWN):
    everything = {obj.name for obj in bpy.data.objects if obj.r5dgs.role == "CLOUD"}
    assert own <= everything
    for t, there in expected.items():
        motions.go_to(bpy, collection, t)
        wanted = everything if there else everything - own
        assert drawn(bpy) == wanted and in_renders(bpy) == wanted, t


def test_objects_and_their_shadows_are_hidden_while_they_are_absent(blender, loaded):
    assert_there(blender, loaded)
    keyed = {obj.name for obj in loaded.all_objects if obj.r5dgs.role == "CLOUD" and obj.animation_data is not None}
    assert keyed == OWN


def test_the_first_picture_after_loading_lacks_what_is_absent(blender, scene, tmp_path):
    blender.context.scene.frame_set(3)
    motions.load_again(blender, tmp_path / "scene.r5dgs")
    assert drawn(blender) & OWN == set() and in_renders(blender) & OWN == set()


def test_saving_undo_and_extrapolation_keep_the_keys(blender, loaded, tmp_path):
    motions.choose(blender, blender.data.objects["mug anchor"])
    blender.data.objects["mug anchor"].r5dgs_motion.velocity[0] += 0.5
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert_there(blender, loaded)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    collection = next(one for one in blender.data.collections if one.r5dgs.is_scene)
    assert_there(blender, collection)
    blender.ops.ed.undo_push(message="before")
    blender.data.objects["mug"].location.x += 1
    blender.ops.ed.undo_push(message="after")
    blender.ops.ed.undo()
    assert_there(blender, next(one for one in blender.data.collections if one.r5dgs.is_scene))


def test_isolating_hides_keyed_objects_at_all_frames_and_gives_the_keys_back(blender, loaded):
    motions.go_to(blender, loaded, 0.2)
    blender.ops.r5dgs.isolate(text="red apple")
    for t in THERE:
        motions.go_to(blender, loaded, t)
        assert drawn(blender) == in_renders(blender) == {"red apple"}
    motions.go_to(blender, loaded, 0.0)
    blender.ops.r5dgs.unisolate()
    assert_there(blender, loaded)
    blender.ops.r5dgs.isolate(text="mug")
    for t, there in THERE.items():
        motions.go_to(blender, loaded, t)
        assert drawn(blender) == in_renders(blender) == ({"mug"} if there else set())
    blender.ops.r5dgs.unisolate()
    assert_there(blender, loaded)


def test_the_list_switches_renders_off_at_all_frames(blender, loaded):
    entry = next(one for one in loaded.r5dgs.table if one.object_id == 1)
    rows = motions.addon("scene.object_list")
    rows.set_hidden_in_renders(entry, True)
    for t in THERE:
        motions.go_to(blender, loaded, t)
        assert rows.is_hidden_in_renders(entry) and "mug" not in in_renders(blender)
    rows.set_hidden_in_renders(entry, False)
    assert not rows.is_hidden_in_renders(entry)
    assert_there(blender, loaded)


def test_a_copy_enters_at_the_same_time_and_is_hidden_alone(blender, loaded):
    motions.choose(blender, blender.data.objects["mug anchor"])
    assert blender.ops.r5dgs.duplicate_object() == {"FINISHED"}
    assert_there(blender, loaded, own=OWN | {"mug.001", "mug shadow.001"})
    motions.addon("scene.presence_keys").hide_in_renders(blender.data.objects["mug.001"], True)
    motions.go_to(blender, loaded, 0.2)
    assert "mug" in in_renders(blender) and "mug.001" not in in_renders(blender)
    actions = len(blender.data.actions)
    motions.choose(
        blender,
        blender.data.objects["mug.001 anchor" if "mug.001 anchor" in blender.data.objects else "mug anchor.001"],
    )
    assert blender.ops.r5dgs.delete_object() == {"FINISHED"}
    assert len(blender.data.actions) == actions - 4


def test_a_retimed_object_enters_when_its_motion_says(blender, loaded):
    blender.ops.r5dgs.retime(kind="SPEED", which="SCENE", speed=50)
    twice = {2 * t: there for t, there in THERE.items()}
    assert_there(blender, loaded, twice)
    entry = next(one for one in loaded.r5dgs.table if one.object_id == 1)
    rows = motions.addon("scene.object_list")
    rows.set_hidden_in_renders(entry, True)
    motions.go_to(blender, loaded, 0.6)
    assert "mug" not in in_renders(blender)
    rows.set_hidden_in_renders(entry, False)
    assert_there(blender, loaded, twice)
    blender.ops.r5dgs.retime(kind="NONE", which="SCENE")
    assert_there(blender, loaded)


def test_the_shadow_of_a_body_on_meshes_is_there_while_the_body_is(blender, loaded):
    blender.ops.r5dgs.merge_with_meshes()
    motions.go_to(blender, loaded, 0.0)
    operator = importlib.import_module("r5dgs.operators.add_shadows").R5DGS_OT_add_shadows
    job = SimpleNamespace(answers=lambda: [])
    given = SimpleNamespace(_job=job, _background=(), report=lambda *said: None)
    assert operator._finish(given, blender.context, None) == {"FINISHED"}
    proxies = {obj.parent.name: obj for obj in blender.data.objects if obj.name.endswith("shadow proxy")}
    assert set(proxies) == {"mug", "red apple", "toy car"}
    for t, there in THERE.items():
        motions.go_to(blender, loaded, t)
        scene = blender.context.scene
        scene.r5dgs_render.meshes.frame_set(scene.frame_current, subframe=scene.frame_subframe)
        shown = {name for name, obj in proxies.items() if not (obj.hide_render or obj.hide_viewport)}
        assert shown == ({"mug", "red apple", "toy car"} if there else {"red apple", "toy car"})


def save(bpy, path):
    assert bpy.ops.r5dgs.export_scene(filepath=str(path)) == {"FINISHED"}
    return scene_file.read(path)


def absences(scene):
    return {(group.object_id, group.role): group.absent for group in scene.groups if group.absent}


def test_a_saved_scene_keeps_its_times_and_edited_keys_change_them(blender, scene, loaded, tmp_path):
    motions.go_to(blender, loaded, 0.0)
    written = save(blender, tmp_path / "new.r5dgs")
    assert absences(written) == absences(scene) and len(absences(scene)) == 2
    np.testing.assert_array_equal(written.tracks.poses, scene.tracks.poses)
    assert_there(blender, loaded)
    for curve in motions.addon("compat").fcurves(blender.data.objects["mug"]):
        curve.keyframe_points[1].co.x = 1 + 60 * 0.25
    blender.data.objects["mug shadow"].animation_data_clear()
    changed = absences(save(blender, tmp_path / "changed.r5dgs"))
    assert changed == {(1, "body"): ((-np.inf, pytest.approx(0.26)), (pytest.approx(0.325), pytest.approx(0.45)))}


def test_a_saved_scene_has_the_times_of_a_retimed_object(blender, loaded, tmp_path):
    blender.ops.r5dgs.retime(kind="SPEED", which="SCENE", speed=50)
    found = absences(save(blender, tmp_path / "slow.r5dgs"))
    assert found[1, "body"] == found[1, "shadow"]
    (_, enters), (leaves, returns) = found[1, "body"]
    assert 0.22 < enters < 0.3 and 0.62 < leaves < 0.68 and 0.88 < returns < 0.92


def test_exports_hold_what_is_absent_at_the_current_frame_but_not_what_users_hide(blender, scene, loaded, tmp_path):
    motions.go_to(blender, loaded, 0.0)
    blender.data.objects["red apple"].hide_set(True)
    path = tmp_path / "new.r5dgs"
    assert blender.ops.r5dgs.export_format(filepath=str(path), format="r5dgs") == {"FINISHED"}
    written, apple = scene_file.read(path), {2}
    assert absences(written) == absences(scene)
    counts = ({item.id: item.count for item in one.objects if item.count} for one in (written, scene))
    assert {object_id for object_id, _ in set.symmetric_difference(*(set(one.items()) for one in counts))} == apple
    blender.data.objects["red apple"].hide_set(False)
    assert_there(blender, loaded)


def test_frames_hold_what_enters_after_the_current_one(blender, scene, loaded, tmp_path):
    motions.go_to(blender, loaded, 0.0)
    blender.context.scene.frame_start, blender.context.scene.frame_end = 1, 13  # up to 0.2
    options = {"filepath": str(tmp_path / "a.ply"), "format": "ply", "frames": "RANGE", "frame_step": 12}
    assert blender.ops.r5dgs.export_format(**options) == {"FINISHED"}
    for frame, t in ((1, 0.0), (13, 0.2)):
        wanted = len(played_splats.at(scene_player.Player(scene), t).means)
        assert len(ply.read(tmp_path / f"a_{frame:04d}.ply").means) == wanted


def test_an_object_whose_keys_always_hide_it_is_left_out(blender, loaded, tmp_path):
    for curve in motions.addon("compat").fcurves(blender.data.objects["mug"]):
        while len(curve.keyframe_points) > 1:
            curve.keyframe_points.remove(curve.keyframe_points[1])
        curve.keyframe_points[0].co.y = 1
    written = save(blender, tmp_path / "new.r5dgs")
    assert "mug" not in {item.name for item in written.objects}


def test_keys_that_the_user_mutes_are_not_saved_but_those_of_hidden_objects_are(blender, scene, loaded, tmp_path):
    entry = next(one for one in loaded.r5dgs.table if one.object_id == 1)
    motions.addon("scene.object_list").set_hidden_in_renders(entry, True)
    assert absences(save(blender, tmp_path / "hidden.r5dgs")) == absences(scene)
    motions.addon("scene.object_list").set_hidden_in_renders(entry, False)
    mug = blender.data.objects["mug"]
    for curve in motions.addon("compat").fcurves(mug):
        curve.mute = True
    mug.hide_viewport = mug.hide_render = False
    assert {role for _, role in absences(save(blender, tmp_path / "muted.r5dgs"))} == {"shadow"}

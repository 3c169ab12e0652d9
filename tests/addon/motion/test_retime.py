"""Retimed objects play the core's motion at other times, in Blender, renders and exports; their keys do not change."""

import numpy as np
import pytest

from r5dgs_core.formats import ply
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, tiny_datasets

FRAMES = (1, 8.37, 30.0, 46.5, 52.25, 61, 90.5, 130)


@pytest.fixture
def scene(scene_path):
    return scene_file.read(scene_path)


def bounds(collection):
    state = collection.r5dgs
    return (state.frame_zero + t * state.frames_per_unit for t in (state.t_start, state.t_end))


def at(frame, kind, first, last):
    """Frame of the motion that a retimed object shows."""
    if kind == "SPEED":
        return min(max(first + 0.5 * (frame - first), first), last)
    if kind == "REVERSE":
        return min(max(first + last - frame, first), last)
    if kind == "HOLD":  # at frame 20, for 24 frames
        return min(frame if frame < 20 else max(20, frame - 24), last)
    span = last - first
    if kind == "LOOP":
        return first + (frame - first) % span
    place = (frame - first) % (2 * span)
    return first + min(place, 2 * span - place)


def go_to(bpy, frame):
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=float(frame % 1))


def assert_shows(bpy, collection, scene, frame, source):
    """Assert that all points are where the core has them at another frame."""
    go_to(bpy, frame)
    state = collection.r5dgs
    t = (source - state.frame_zero) / state.frames_per_unit
    expected = scene_player.Player(scene).frame(t).means @ cameras.WORLD_TO_BLENDER[scene.world_convention].T
    found = motions.all_points(bpy, collection, len(expected))
    np.testing.assert_allclose(found, expected, atol=2e-5 * scene.extent, err_msg=f"frame {frame}")


@pytest.mark.parametrize("kind", ["SPEED", "HOLD", "REVERSE", "PING_PONG", "LOOP"])
def test_a_retimed_scene_shows_the_motion_of_other_frames(blender, loaded, scene, kind):
    first, last = bounds(loaded)
    blender.context.scene.frame_set(20)
    assert blender.ops.r5dgs.retime(kind=kind, which="SCENE") == {"FINISHED"}
    for frame in FRAMES:
        if kind in ("LOOP", "PING_PONG") and abs((frame - first) % (last - first)) < 1e-6:
            continue  # both ends of a period are shown there
        assert_shows(blender, loaded, scene, frame, at(frame, kind, first, last))


def test_the_picture_changes_at_once_and_the_original_returns_with_its_action(blender, loaded, scene, mug):
    action = mug.animation_data.action
    keys = motions.keys(mug)
    blender.context.scene.frame_set(10)
    before = motions.matrix(blender, mug)
    blender.ops.r5dgs.retime(kind="REVERSE", which="SCENE")
    assert np.abs(motions.matrix(blender, mug) - before).max() > 1e-3
    assert mug.animation_data.action is None
    blender.ops.r5dgs.retime(kind="NONE", which="SCENE")
    np.testing.assert_allclose(motions.matrix(blender, mug), before, atol=1e-6)
    assert mug.animation_data.action == action and not mug.animation_data.nla_tracks
    assert motions.keys(mug) == keys
    motions.assert_plays_like_the_core(blender, loaded, scene, (0.2, 0.9))


def test_only_the_selected_objects_and_their_shadows_are_retimed(blender, loaded, mug):
    blender.ops.r5dgs.retime(kind="REVERSE")
    retiming = motions.addon("scene.retiming")
    found = {one.name for one in loaded.all_objects if one.r5dgs.role == "ANCHOR" and retiming.strip_of(one)}
    assert found == {"mug anchor", "mug shadow anchor"}


def test_an_edited_curve_is_copied_to_other_objects(blender, loaded, mug):
    blender.ops.r5dgs.retime(kind="CURVE")
    retiming = motions.addon("scene.retiming")
    curve = retiming.curve_of(retiming.strip_of(mug))
    assert retiming.source_frame(mug, 33.25) == pytest.approx(33.25)
    curve.keyframe_points.insert(30, 12)
    curve.update()
    other = next(one for one in loaded.all_objects if one.name == "red apple anchor")
    other.select_set(True)
    blender.ops.r5dgs.retime(kind="ACTIVE")
    assert retiming.source_frame(other, 30) == retiming.source_frame(mug, 30) == pytest.approx(12)


def test_keys_written_later_play_retimed(blender, loaded, mug):
    blender.ops.r5dgs.retime(kind="SPEED", speed=50.0)
    mug.r5dgs_motion.velocity = (4.0, 5.0, 6.0)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    blender.context.scene.frame_set(110)  # shows 55.5
    slow = motions.matrix(blender, mug)
    blender.ops.r5dgs.retime(kind="NONE")
    go_to(blender, 55.5)
    np.testing.assert_allclose(motions.matrix(blender, mug), slow, atol=1e-5)
    blender.context.scene.frame_set(1)
    assert np.abs(motions.matrix(blender, mug) - slow).max() > 1e-2


def test_undo_and_redo(blender, loaded, mug):
    retiming = motions.addon("scene.retiming")
    blender.ops.ed.undo_push(message="before")
    blender.ops.r5dgs.retime(kind="REVERSE")
    blender.ops.ed.undo_push(message="Retime")
    blender.ops.ed.undo()
    assert retiming.strip_of(blender.data.objects["mug anchor"]) is None
    assert blender.data.objects["mug anchor"].animation_data.action is not None
    blender.ops.ed.redo()
    assert retiming.strip_of(blender.data.objects["mug anchor"]) is not None


def test_refusals_name_the_object_and_change_nothing(blender, loaded, mug):
    with pytest.raises(RuntimeError, match="expected an active object with a retiming"):
        blender.ops.r5dgs.retime(kind="ACTIVE")
    action = mug.animation_data.action
    track = mug.animation_data.nla_tracks.new()
    track.strips.new("own", 1, action)
    mug.animation_data.action = None
    with pytest.raises(RuntimeError, match="mug anchor: its motion is an NLA strip already"):
        blender.ops.r5dgs.retime(kind="REVERSE", which="SCENE")
    others = [one for one in loaded.all_objects if one.r5dgs.role == "ANCHOR" and one != mug and one.animation_data]
    assert others and not any(one.animation_data.nla_tracks for one in others)


def test_objects_that_bend_are_retimed_with_their_bending(blender, tmp_path):
    bending = tiny_datasets.breathing(tiny_datasets.make_truth(), 0.3)
    scene = scene_file.read(scene_file.write(bending, tmp_path / "bending.r5dgs"))
    collection = motions.load(blender, tmp_path / "bending.r5dgs")
    first, last = bounds(collection)
    blender.context.scene.frame_set(20)
    for kind in ("REVERSE", "SPEED"):
        blender.ops.r5dgs.retime(kind=kind, which="SCENE")
        for frame in (last - 12.0, last - 20.3, first + 9.0):
            source = at(frame, kind, first, last)
            assert_shows(blender, collection, scene, frame, source)
            blender.ops.r5dgs.export_ply(filepath=str(tmp_path / "a.ply"), axes="FILE")
            t = (source - collection.r5dgs.frame_zero) / collection.r5dgs.frames_per_unit
            wanted = scene_player.Player(scene).frame(t).means
            found = ply.read(tmp_path / "a.ply").means
            np.testing.assert_allclose(np.sort(found, axis=0), np.sort(wanted, axis=0), atol=2e-5 * scene.extent)
            instances = motions.addon("engine.visible_clouds").instances(blender.context.evaluated_depsgraph_get())[1]
            bends = [one for one in instances if "bind_state:position" in one.object.data.attributes]
            assert bends and [one.t for one in bends] == pytest.approx([t] * len(bends), abs=1e-5)


def test_the_edited_scene_holds_the_retimed_motion(blender, loaded, scene, tmp_path):
    first, last = bounds(loaded)
    blender.ops.r5dgs.retime(kind="REVERSE", which="SCENE")
    blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "back.r5dgs"))
    found = scene_file.read(tmp_path / "back.r5dgs")
    for t in found.tracks.times[1:-1:4].tolist():
        frame = loaded.r5dgs.frame_zero + t * loaded.r5dgs.frames_per_unit
        source = (at(frame, "REVERSE", first, last) - loaded.r5dgs.frame_zero) / loaded.r5dgs.frames_per_unit
        wanted, own = scene_player.Player(scene).frame(source).means, scene_player.Player(found).frame(t).means
        np.testing.assert_allclose(np.sort(own, axis=0), np.sort(wanted, axis=0), atol=1e-3 * scene.extent)

"""Edited physics change the keys past t_max and nothing else."""

import dataclasses
import importlib
import math

import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes

T_MAX = scenes.T_MAX
LAST = 1 + 60 * T_MAX  # frame of t_max
TIMES = (0.0, 0.3334, 0.7499, T_MAX, 0.7507, 0.9111, 1.0)


def remove_key_at_t_max(curve):
    """Remove the key at t_max. Returns its index."""
    at = next(k for k, point in enumerate(curve.keyframe_points) if abs(point.co[0] - LAST) < 1e-3)
    curve.keyframe_points.remove(curve.keyframe_points[at])
    return at


def per_second(bpy, value, power=1):
    """A rate per unit of scene time in Blender's units."""
    return value * (bpy.context.scene.render.fps / 60.0) ** power


def test_fields_show_the_learned_motion_per_second_of_blenders_time(blender, scene_path, mug):
    model = scene_file.read(scene_path).groups[1].model
    state = mug.r5dgs_motion
    for fps in (24, 30):
        blender.context.scene.render.fps = fps
        assert state.kind == "ballistic_spin"
        np.testing.assert_allclose(state.velocity, model.velocity * fps / 60, rtol=1e-6)
        np.testing.assert_allclose(state.acceleration, model.acceleration * (fps / 60) ** 2, rtol=1e-6)
        np.testing.assert_allclose(state.angular_velocity, model.angular_velocity * fps / 60, rtol=1e-6)
        np.testing.assert_allclose(state.angular_acceleration, model.angular_acceleration * (fps / 60) ** 2, rtol=1e-6)
    assert not motions.addon("motion.physics").edited(state)


def test_a_motion_that_was_not_edited_is_written_as_it_was_learned(blender, scene_path, loaded):
    anchors = [obj for obj in loaded.all_objects if obj.r5dgs.role == "ANCHOR"]
    motions.choose(blender, *anchors)
    before = {anchor.name: motions.keys(anchor) for anchor in anchors}
    for _ in range(2):
        assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    for anchor in anchors:
        after = motions.keys(anchor)
        assert after.keys() == before[anchor.name].keys()
        for name, rows in after.items():  # the cubic across t_max now has a key there
            assert 0 <= len(rows) - len(before[anchor.name][name]) <= 1
    motions.assert_plays_like_the_core(blender, loaded, scene_file.read(scene_path), TIMES)


def test_an_edited_velocity_moves_that_far_and_leaves_the_observed_keys_to_the_bit(blender, loaded, mug):
    before = motions.keys(mug, LAST)
    state = mug.r5dgs_motion
    state.kind, state.frequency = "translation", 0.0
    state.velocity, state.acceleration = (per_second(blender, 1.0), 0.0, 0.0), (0.0, 0.0, 0.0)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert motions.keys(mug, LAST) == before
    motions.go_to(blender, loaded, T_MAX)
    start = motions.matrix(blender, mug)
    for frames in (0.5, 6.0, 15.0):  # 60 frames are a unit of time, in which it moves by one
        motions.go_to(blender, loaded, T_MAX + frames / 60)
        moved = motions.matrix(blender, mug)
        np.testing.assert_allclose(moved[:3, 3] - start[:3, 3], [frames / 60, 0, 0], atol=2e-6)
        np.testing.assert_allclose(moved[:3, :3], start[:3, :3], atol=1e-6)


def test_the_motion_is_continuous_at_t_max(blender, loaded, mug):
    mug.r5dgs_motion.velocity = (3.0, -2.0, 1.0)
    mug.r5dgs_motion.angular_velocity = (0.0, 4.0, 0.0)
    blender.ops.r5dgs.re_extrapolate()
    step = 1e-3
    around = []
    for t in (T_MAX - step / 60, T_MAX, T_MAX + step / 60):
        motions.go_to(blender, loaded, t)
        around.append(motions.matrix(blender, mug))
    for side in (around[0], around[2]):
        assert np.abs(side - around[1]).max() < 30 * step / 60


@pytest.mark.parametrize("kind", [name for name, kind in models.KINDS.items() if not kind.needs_knots])
def test_static_objects_can_get_any_kind_of_motion(blender, loaded, kind):
    anchor = blender.data.objects["wooden block anchor"]
    motions.choose(blender, anchor)
    state = anchor.r5dgs_motion
    assert state.kind == "static" and not motions.curves(anchor)
    rates = {
        "velocity": [0.4, 0.0, 0.8],
        "acceleration": [0.0, 0.0, -2.0],
        "angular_velocity": [0.5, 2.0, -1.0],
        "angular_acceleration": [0.0, 0.3, 0.0],
        "center_offset": [0.1, 0.0, 0.2],
    }
    own = {*models.KINDS[kind].fields} & {*models.VECTORS} - {*models.RATES}
    rates |= dict.fromkeys(own, [0.3, -0.4, 0.6])
    factor = blender.context.scene.render.fps / 60
    state.kind = kind
    for name, value in rates.items():
        setattr(state, name, np.array(value) * factor ** models.FIELDS[name].per_time)
    blender.ops.r5dgs.re_extrapolate()
    inertia = motions.addon("motion.physics").inertia(anchor) if kind == "free_top" else None
    model = models.MotionModel(kind, **rates, inertia=inertia)
    pivot = np.array(anchor.r5dgs.pivot)
    for t in (0.2, T_MAX, 0.8, 0.95):
        motions.go_to(blender, loaded, t)
        quat, displacement = models.evaluate(model, max(t - T_MAX, 0.0))
        found = motions.matrix(blender, anchor)
        np.testing.assert_allclose(found[:3, 3], pivot + displacement, atol=3e-5)
        np.testing.assert_allclose(found[:3, :3], rotations.quats_to_rotmats(quat), atol=1e-4)
    assert bool(motions.curves(anchor)) == (kind != "static")


def test_no_scene_file_is_needed(blender, scene_path, tmp_path):
    motions.load(blender, scene_path)
    blend = tmp_path / "saved.blend"
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    scene = scene_file.read(scene_path)
    scene_path.unlink()
    blender.ops.wm.read_homefile(app_template="")
    blender.ops.wm.open_mainfile(filepath=str(blend))
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    anchor = blender.data.objects["toy car anchor"]
    motions.choose(blender, anchor)
    anchor.r5dgs_motion.velocity = (5.0, 0.0, 0.0)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    motions.go_to(blender, collection, 0.9)
    assert np.linalg.norm(motions.matrix(blender, anchor)[:3, 3] - scene.groups[3].pivot) > 0.5
    assert blender.ops.r5dgs.extrapolate_until(t_end=1.25) == {"FINISHED"}
    assert blender.ops.r5dgs.reset_motion() == {"FINISHED"}
    motions.assert_plays_like_the_core(blender, collection, scene, (*TIMES, 1.2))


def test_the_motion_starts_at_the_pose_that_the_user_set(blender, loaded, mug):
    """Moved, rotated and added keys before t_max, and other channels, do not change."""
    turn = rotations.rotvecs_to_quats(np.array([0.0, 0.0, math.pi / 2]))
    for (path, index), curve in motions.curves(mug).items():
        for point in curve.keyframe_points:
            if path == "location":
                point.co_ui = (point.co[0], point.co[1] + (0.5, -0.25, 0.125)[index])
            elif abs(point.co[0] - LAST) < 1e-3:
                point.co_ui = (point.co[0], turn[index])
    mug.scale = (2.0, 1.0, 1.0)
    mug.keyframe_insert("scale", frame=20)
    mug.scale = (1.0, 1.0, 1.0)
    mug.keyframe_insert("scale", frame=60)
    before = motions.keys(mug, LAST)
    scales = {name: rows for name, rows in motions.keys(mug).items() if name[0] == "scale"}
    motions.go_to(blender, loaded, T_MAX)
    start = motions.matrix(blender, mug)
    state = mug.r5dgs_motion
    state.kind, state.velocity, state.angular_velocity = "constant_twist", (0, 0, 0), (0, 0, per_second(blender, 2.0))
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    after = motions.keys(mug, LAST)
    for name in before:
        if name[0] != "scale":
            assert after[name] == before[name]
    assert {name: rows for name, rows in motions.keys(mug).items() if name[0] == "scale"} == scales
    motions.go_to(blender, loaded, T_MAX + 0.2)
    moved = motions.matrix(blender, mug)
    np.testing.assert_allclose(moved[:3, 3], start[:3, 3], atol=1e-5)  # about its own place
    spin = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array([0, 0, 0.4])))
    directions = start[:3, :3] / np.linalg.norm(start[:3, :3], axis=0)
    found = moved[:3, :3] / np.linalg.norm(moved[:3, :3], axis=0)
    np.testing.assert_allclose(found, spin @ directions, atol=1e-4)


@pytest.mark.parametrize("handles", ["FREE", "AUTO", "AUTO_CLAMPED", "VECTOR", "ALIGNED"])
def test_handles_of_any_type_before_t_max_stay_where_they_are(blender, mug, handles):
    for curve in motions.curves(mug).values():
        for point in curve.keyframe_points:
            point.handle_left_type = point.handle_right_type = handles
        curve.update()
    before = motions.keys(mug, LAST)
    mug.r5dgs_motion.velocity = (9.0, 9.0, 9.0)
    blender.ops.r5dgs.re_extrapolate()
    assert motions.keys(mug, LAST) == before


@pytest.mark.parametrize("interpolation", ["BEZIER", "LINEAR", "CONSTANT"])
def test_a_curve_without_a_key_at_t_max_is_cut_there_and_keeps_its_shape(blender, loaded, mug, interpolation):
    for curve in motions.curves(mug).values():
        remove_key_at_t_max(curve)
        for point in curve.keyframe_points:
            point.interpolation = interpolation
        curve.update()
    frames = np.linspace(1, LAST, 40)
    before = {name: [curve.evaluate(f) for f in frames] for name, curve in motions.curves(mug).items()}
    mug.r5dgs_motion.velocity = (1.0, 2.0, 3.0)
    blender.ops.r5dgs.re_extrapolate()
    for name, curve in motions.curves(mug).items():
        np.testing.assert_allclose([curve.evaluate(f) for f in frames], before[name], atol=2e-6)
        assert any(abs(point.co[0] - LAST) < 1e-3 for point in curve.keyframe_points)


@pytest.mark.parametrize("reach", [0.5, 0.75, 0.9, 0.97])
def test_a_curve_whose_handles_overlap_keeps_its_shape_when_it_is_cut(blender, loaded, mug, reach):
    for curve in motions.curves(mug).values():
        at, points = remove_key_at_t_max(curve), curve.keyframe_points
        left, right = points[at - 1], points[at]
        gap = right.co[0] - left.co[0]
        for point in (left, right):
            point.handle_left_type = point.handle_right_type = "FREE"
            point.interpolation = "BEZIER"
        left.handle_right = (left.co[0] + reach * gap, left.co[1] + 0.3)
        right.handle_left = (right.co[0] - reach * gap, right.co[1] + 0.2)
        curve.update()
    frames = np.linspace(1, LAST, 80)
    before = {name: [curve.evaluate(f) for f in frames] for name, curve in motions.curves(mug).items()}
    mug.r5dgs_motion.velocity = (1.0, 2.0, 3.0)
    blender.ops.r5dgs.re_extrapolate()
    for name, curve in motions.curves(mug).items():
        np.testing.assert_allclose([curve.evaluate(f) for f in frames], before[name], atol=5e-6)


def test_curves_that_cannot_be_cut_raise_and_stay_unchanged(blender, mug):
    for curve in motions.curves(mug).values():
        remove_key_at_t_max(curve)
        for point in curve.keyframe_points:
            point.interpolation = "ELASTIC"
    before = motions.keys(mug)
    with pytest.raises(RuntimeError, match="set a key at frame 46"):
        blender.ops.r5dgs.re_extrapolate()
    assert motions.keys(mug) == before


def test_another_rotation_mode_is_refused_by_name(blender, mug):
    mug.rotation_mode = "XYZ"
    with pytest.raises(RuntimeError, match=r"mug anchor.*Quaternion"):
        blender.ops.r5dgs.re_extrapolate()


def test_a_shadow_follows_its_caster_again(blender, loaded, mug):
    shadow = blender.data.objects["mug shadow anchor"]
    assert shadow.r5dgs_motion.leader == mug
    follow = np.diag([1.0, 1.0, 0.0])
    follow[0, 2] = 0.3
    state = mug.r5dgs_motion
    state.kind, state.velocity, state.acceleration = "translation", (1.0, -2.0, 3.0), (0, 0, 0)
    blender.ops.r5dgs.re_extrapolate()
    places = {}
    for t in (T_MAX, 0.9):
        motions.go_to(blender, loaded, t)
        places[t] = [motions.matrix(blender, obj)[:3, 3] for obj in (mug, shadow)]
    moved, dragged = (places[0.9][k] - places[T_MAX][k] for k in (0, 1))
    assert np.linalg.norm(moved) > 0.1
    np.testing.assert_allclose(dragged, follow @ moved, atol=1e-5)


def push_down(bpy, anchor):
    """Push the action down to an NLA strip, like *Push Down*."""
    action = anchor.animation_data.action
    slot = getattr(anchor.animation_data, "action_slot", None)
    track = anchor.animation_data.nla_tracks.new()
    strip = track.strips.new(action.name, int(action.frame_range[0]), action)
    if slot is not None:
        strip.action_slot = slot
    anchor.animation_data.action = None
    return strip


def test_an_action_in_the_nla_is_updated_in_place(blender, loaded, mug):
    push_down(blender, mug)
    state = mug.r5dgs_motion
    state.kind, state.velocity, state.acceleration = "translation", (per_second(blender, 1.0), 0, 0), (0, 0, 0)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert blender.ops.r5dgs.extrapolate_until(t_end=1.5) == {"FINISHED"}
    assert mug.animation_data.action is None
    motions.go_to(blender, loaded, T_MAX)
    start = motions.matrix(blender, mug)[:3, 3]
    motions.go_to(blender, loaded, 1.45)
    np.testing.assert_allclose(motions.matrix(blender, mug)[:3, 3] - start, [0.7, 0, 0], atol=1e-5)


def test_a_moved_and_slowed_strip_plays_the_new_motion(blender, loaded, mug):
    strip = push_down(blender, mug)
    strip.scale = 2.0
    strip.frame_start, strip.frame_end = 11, 11 + 2 * 60
    before = {name: rows for name, rows in strip_keys(strip, LAST).items()}
    state = mug.r5dgs_motion
    state.kind, state.velocity, state.acceleration = "translation", (per_second(blender, 1.0), 0, 0), (0, 0, 0)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert strip_keys(strip, LAST) == before
    places = []
    for frame in (LAST, LAST + 9):
        blender.context.scene.frame_set(int(11 + 2 * (frame - 1)))
        places.append(motions.matrix(blender, mug)[:3, 3])
    np.testing.assert_allclose(places[1] - places[0], [9 / 60, 0, 0], atol=1e-5)


def strip_keys(strip, until):
    """Keys of the action of a strip up to a frame."""
    found = motions.addon("motion.curve_place").Place(strip.action, getattr(strip, "action_slot", None)).curves()
    return {
        name: [(tuple(p.co), tuple(p.handle_left)) for p in curve.keyframe_points if p.co[0] <= until + 1e-3]
        for name, curve in found.items()
    }


def test_several_strips_of_the_nla_are_refused(blender, loaded, mug):
    strip = push_down(blender, mug)
    again = mug.animation_data.nla_tracks.new().strips.new("again", 100, strip.action)
    if hasattr(strip, "action_slot"):
        again.action_slot = strip.action_slot
    with pytest.raises(RuntimeError, match="2 NLA strips"):
        blender.ops.r5dgs.re_extrapolate()


def test_a_shared_action_is_copied_before_it_is_written(blender, loaded, mug):
    other = mug.copy()
    loaded.objects.link(other)
    motions.choose(blender, mug)
    assert other.animation_data.action == mug.animation_data.action
    before = motions.keys(other)
    mug.r5dgs_motion.velocity = (4.0, 0.0, 0.0)
    blender.ops.r5dgs.re_extrapolate()
    assert other.animation_data.action != mug.animation_data.action
    assert motions.keys(other) == before


def test_reset_brings_the_learned_motion_back(blender, scene_path, loaded, mug):
    state = mug.r5dgs_motion
    state.kind, state.velocity = "constant_twist", (4.0, 5.0, 6.0)
    blender.ops.r5dgs.re_extrapolate()
    assert blender.ops.r5dgs.reset_motion() == {"FINISHED"}
    assert state.kind == "ballistic_spin" and not motions.addon("motion.physics").edited(state)
    motions.assert_plays_like_the_core(blender, loaded, scene_file.read(scene_path), TIMES)


def test_reset_changes_nothing_if_a_follower_cannot_be_reset(blender, loaded, mug):
    curve = next(iter(motions.curves(mug).values()))
    curve.keyframe_points[0].co.y += 1
    before = motions.keys(mug)
    blender.data.objects["mug shadow anchor"].rotation_mode = "XYZ"
    with pytest.raises(RuntimeError, match="mug shadow anchor.*Quaternion"):
        blender.ops.r5dgs.reset_motion(observed=True)
    assert motions.keys(mug) == before


def test_reset_restores_observed_keys_from_the_file_on_request(blender, scene_path, loaded, mug):
    mug.scale = (2.0, 2.0, 2.0)
    mug.keyframe_insert("scale", frame=20)
    mug.scale = (1.0, 1.0, 1.0)
    for (path, _), curve in motions.curves(mug).items():
        if path == "location":
            for point in curve.keyframe_points:
                point.co_ui = (point.co[0], point.co[1] + 1.0)
    blender.ops.r5dgs.reset_motion()
    motions.go_to(blender, loaded, 0.3)
    pivot = scene_file.read(scene_path).groups[1].pivot
    assert np.linalg.norm(motions.matrix(blender, mug)[:3, 3] - pivot) > 1
    assert blender.ops.r5dgs.reset_motion(observed=True) == {"FINISHED"}
    assert len(motions.curves(mug)["scale", 0].keyframe_points) == 1
    for curve in [curve for name, curve in motions.curves(mug).items() if name[0] == "scale"]:
        motions.addon("compat").fcurves(mug).remove(curve)
    mug.scale = (1.0, 1.0, 1.0)
    motions.assert_plays_like_the_core(blender, loaded, scene_file.read(scene_path), TIMES)


def test_reset_with_a_missing_file_raises_and_changes_nothing(blender, scene_path, loaded, mug):
    scene_path.unlink()
    before = motions.keys(mug)
    with pytest.raises(RuntimeError, match="synthetic.r5dgs"):
        blender.ops.r5dgs.reset_motion(observed=True)
    assert motions.keys(mug) == before


@pytest.mark.parametrize("t_end", [1.7, 0.85, T_MAX, 0.2])
def test_the_extrapolation_is_extended_and_shortened(blender, scene_path, loaded, t_end):
    scene = scene_file.read(scene_path)
    assert blender.ops.r5dgs.extrapolate_until(t_end=t_end) == {"FINISHED"}
    end = max(t_end, T_MAX)
    assert loaded.r5dgs.t_end == pytest.approx(end)
    assert blender.context.scene.frame_end == math.ceil(1 + 60 * end - 1e-4)
    last = max(p.co[0] for a in loaded.all_objects for c in motions.curves(a).values() for p in c.keyframe_points)
    assert last == pytest.approx(1 + 60 * end, abs=1e-3)
    motions.assert_plays_like_the_core(blender, loaded, scene, (*(t for t in TIMES if t <= end), end))


def test_a_later_end_uses_edited_physics_and_keeps_keys_edited_by_hand(blender, loaded, mug, capfd):
    car = blender.data.objects["toy car anchor"]
    curve = motions.curves(car)["location", 1]
    curve.keyframe_points[-1].co_ui = (curve.keyframe_points[-1].co[0], 7.0)
    by_hand = motions.keys(car)
    state = mug.r5dgs_motion
    state.kind, state.velocity, state.acceleration = "translation", (0, 0, per_second(blender, 2.0)), (0, 0, 0)
    assert blender.ops.r5dgs.extrapolate_until(t_end=1.5) == {"FINISHED"}
    assert "toy car anchor" in capfd.readouterr().out
    assert motions.keys(car) == by_hand
    places = []
    for t in (T_MAX, 1.5):
        motions.go_to(blender, loaded, t)
        places.append(motions.matrix(blender, mug)[:3, 3])
    np.testing.assert_allclose(places[1] - places[0], [0, 0, 1.5], atol=1e-5)


def snapshot(bpy):
    """State that an undo must restore."""
    names = {kind: sorted(d.name for d in getattr(bpy.data, kind)) for kind in ("objects", "collections", "actions")}
    places = {}
    for frame in (1, 30, 55):
        bpy.context.scene.frame_set(frame)
        for obj in bpy.data.objects:
            places[obj.name, frame] = np.round(motions.matrix(bpy, obj), 5).tolist()
    return names, places


@pytest.mark.parametrize(
    "action",
    [
        lambda ops: ops.re_extrapolate(),
        lambda ops: ops.reset_motion(),
        lambda ops: ops.reset_motion(observed=True),
        lambda ops: ops.extrapolate_until(t_end=1.6),
        lambda ops: ops.simplify_keys(),
        lambda ops: ops.replace_motion(),
        lambda ops: ops.duplicate_object(),
        lambda ops: ops.delete_object(),
        lambda ops: ops.show_confidence(),
    ],
)
def test_every_action_can_be_undone_and_redone(blender, loaded, action):
    anchors = [blender.data.objects[f"{name} anchor"] for name in ("toy car", "mug")]
    anchors[1].r5dgs_motion.velocity = (1.0, 2.0, 3.0)
    motions.choose(blender, *anchors)
    blender.ops.ed.undo_push(message="before")
    before = snapshot(blender)
    blender.ops.ed.undo_push(message="before")
    assert action(blender.ops.r5dgs) == {"FINISHED"}
    after = snapshot(blender)
    blender.ops.ed.undo_push(message="action")  # with a window, Blender does this after an operator
    blender.ops.ed.undo()
    assert snapshot(blender) == before
    blender.ops.ed.redo()
    assert snapshot(blender) == after


def test_without_a_selected_object_the_operators_name_the_remedy(blender, loaded):
    motions.choose(blender, loaded.r5dgs.root)
    for name in ("re_extrapolate", "reset_motion", "replace_motion", "duplicate_object", "delete_object"):
        with pytest.raises(RuntimeError, match=r"[Ss]elect"):
            getattr(blender.ops.r5dgs, name)()


def test_far_from_the_origin_extrapolation_still_holds(blender, tmp_path):
    scene = scenes.make_scene(n=300, objects=3)
    shift = np.array([40.0, -25.0, 3.0])
    groups = tuple(dataclasses.replace(g, pivot=g.pivot + shift) for g in scene.groups)
    far = dataclasses.replace(
        scene.with_arrays(means=(scene.gaussians.means + shift).astype(np.float32)), groups=groups
    )
    path = scene_file.write(far, tmp_path / "far.r5dgs")
    collection = motions.load(blender, path)
    blender.ops.r5dgs.extrapolate_until(t_end=1.3)
    motions.assert_plays_like_the_core(blender, collection, scene_file.read(path), (*TIMES, 1.3))
    assert scene_player.Player(far).frame(1.3).means.shape == (300, 3)


def test_key_reduction_keeps_the_tolerance_and_the_ends(blender, scene_path, loaded):
    scene = scene_file.read(scene_path)
    anchors = [o for o in loaded.all_objects if o.r5dgs.role == "ANCHOR" and motions.curves(o)]
    count = sum(len(rows) for anchor in anchors for rows in motions.keys(anchor).values())
    motions.choose(blender, *anchors)
    assert blender.ops.r5dgs.simplify_keys(tolerance=2e-3) == {"FINISHED"}
    fewer = sum(len(rows) for anchor in anchors for rows in motions.keys(anchor).values())
    assert fewer < 0.6 * count
    for t in np.linspace(0, 1, 23):
        motions.go_to(blender, loaded, t)
        frame = scene_player.Player(scene).frame(t)
        for cloud in (o for o in loaded.all_objects if o.r5dgs.role == "CLOUD"):
            rows = slice(cloud.r5dgs.start, cloud.r5dgs.start + cloud.r5dgs.count)
            worst = np.linalg.norm(motions.points(blender, cloud) - frame.means[rows], axis=-1).max()
            assert worst <= 2e-3 * motions.addon("motion.physics").size(cloud.parent) + 1e-5 * scene.extent
    motions.assert_plays_like_the_core(blender, loaded, scene, (0.0, T_MAX, 1.0))
    blender.ops.r5dgs.extrapolate_until(t_end=1.2)  # these were not edited by hand
    motions.assert_plays_like_the_core(blender, loaded, scene, (0.0, T_MAX, 1.2))


def test_kinks_made_by_the_user_survive_key_reduction(blender, loaded, mug):
    curve = motions.curves(mug)["location", 2]
    point = curve.keyframe_points.insert(20.0, 2.0)
    point.handle_left_type = point.handle_right_type = "VECTOR"
    curve.update()
    frames = np.linspace(1, 61, 121)
    before = [curve.evaluate(f) for f in frames]
    assert blender.ops.r5dgs.simplify_keys(tolerance=1e-3) == {"FINISHED"}
    curve = motions.curves(mug)["location", 2]
    np.testing.assert_allclose([curve.evaluate(f) for f in frames], before, atol=1e-3 * 0.6)
    assert curve.evaluate(20.0) == pytest.approx(2.0, abs=1e-5)


def test_stepped_keys_are_not_smoothed_away(blender, loaded, mug):
    for curve in motions.curves(mug).values():
        curve.keyframe_points[0].interpolation = "CONSTANT"
    before = motions.keys(mug)
    with pytest.raises(RuntimeError, match="Constant"):
        blender.ops.r5dgs.simplify_keys()
    assert motions.keys(mug) == before


def test_the_panel_shows_the_fields_of_a_motion_and_marks_edits(blender, loaded, mug):
    panel = blender.types.R5DGS_PT_motion
    for kind, fields in ((name, kind.fields) for name, kind in models.KINDS.items()):
        mug.r5dgs_motion.kind = kind
        said = layouts.draw(blender, panel)
        assert set(fields) <= set(said) and "r5dgs.re_extrapolate" in said
        assert ("As learned" in said) == (kind == "ballistic_spin")
        assert ("Re-Extrapolate writes this to the keys" in said) == (kind != "ballistic_spin")
    mug.r5dgs_motion.kind = "friction"  # a trajectory needs knots
    blender.ops.r5dgs.re_extrapolate()
    assert "Edited" in layouts.draw(blender, panel)
    mug.rotation_mode = "XYZ"
    assert any("expected the rotation mode" in text for text in layouts.draw(blender, panel))
    motions.choose(blender, blender.data.objects["mug shadow anchor"])
    assert "Follows another object" in layouts.draw(blender, panel)
    motions.choose(blender, loaded.r5dgs.root)
    assert "Select an object to see its motion" in layouts.draw(blender, panel)


def test_edited_numbers_are_written_at_once_if_enabled(blender, loaded, mug):
    observed, before = motions.keys(mug, LAST), motions.keys(mug)
    state = mug.r5dgs_motion
    state.kind = "translation"
    assert motions.keys(mug) == before
    state.at_once = True
    state.acceleration = (0.0, 0.0, 0.0)
    state.velocity = (per_second(blender, 2.0), 0.0, 0.0)
    assert motions.keys(mug, LAST) == observed
    places = []
    for t in (T_MAX, 1.0):
        motions.go_to(blender, loaded, t)
        places.append(motions.matrix(blender, mug)[:3, 3])
    np.testing.assert_allclose(places[1] - places[0], [0.5, 0, 0], atol=1e-5)
    mug.rotation_mode = "XYZ"
    state.velocity = (0.0, 0.0, 0.0)  # cannot be written; a slider must not raise an error
    assert not motions.addon("motion.physics").is_written(mug)


def test_linked_objects_are_refused(blender, loaded, tmp_path):
    blend = tmp_path / "library.blend"
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    blender.ops.wm.read_homefile(app_template="")
    with blender.data.libraries.load(str(blend), link=True) as (there, here):
        here.collections = ["R5DGS synthetic"]
    blender.context.scene.collection.children.link(here.collections[0])
    blender.context.view_layer.update()
    mug = blender.data.objects["mug anchor"]
    count = len(blender.data.objects)
    motions.choose(blender, mug)
    for name in ("re_extrapolate", "reset_motion", "duplicate_object", "delete_object", "show_confidence"):
        with pytest.raises(RuntimeError, match="mug anchor: comes from another .blend file"):
            getattr(blender.ops.r5dgs, name)()
    assert len(blender.data.objects) == count


def test_a_spin_too_fast_for_keys_is_keyed_at_every_frame_and_named(blender, loaded, mug, capfd):
    state = mug.r5dgs_motion
    state.kind, state.angular_velocity = "ballistic_spin", (0.0, 300.0, per_second(blender, 1e4))
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert "Keys are exact only at frames, because the motion is too fast: mug anchor" in capfd.readouterr().out
    panel = blender.types.R5DGS_PT_motion
    assert state.too_fast and "Too fast for keys: exact only at frames" in layouts.draw(blender, panel)
    curves = [curve for name, curve in motions.curves(mug).items() if name[0] == "rotation_quaternion"]
    keys = np.array([[point.co for point in curve.keyframe_points if point.co[0] > LAST] for curve in curves])
    np.testing.assert_allclose(keys[0, :, 0], LAST + 1 + np.arange(15))
    model = motions.addon("motion.physics").model(mug)
    quats, _ = models.evaluate(model, (keys[0, :, 0].astype(np.float64) - LAST) / 60)
    assert rotations.angle_between(rotations.normalize(keys[:, :, 1].T), quats).max() < 1e-5
    blender.ops.r5dgs.reset_motion()
    assert not state.too_fast


@pytest.mark.parametrize("speed", [1e9, 1e30, math.inf])
def test_extreme_speeds_do_no_harm(blender, loaded, mug, speed):
    before = motions.keys(mug, LAST)
    mug.r5dgs_motion.velocity = (speed, 0.0, 0.0)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert motions.keys(mug, LAST) == before
    blender.ops.r5dgs.reset_motion()
    assert not motions.addon("motion.physics").edited(mug.r5dgs_motion)


def test_a_velocity_that_is_not_finite_raises_an_error_that_names_it(blender, mug):
    before = motions.keys(mug)
    mug.r5dgs_motion.velocity = (math.nan, 0.0, 0.0)
    with pytest.raises(RuntimeError, match="mug anchor: velocity: expected three finite numbers"):
        blender.ops.r5dgs.re_extrapolate()
    assert motions.keys(mug) == before


def test_an_extreme_end_is_refused_and_nothing_changes(blender, loaded, mug):
    before = motions.keys(mug)
    for t_end in (20.0, math.inf, math.nan):
        with pytest.raises(RuntimeError, match="expected an end of at most 15.75"):
            blender.ops.r5dgs.extrapolate_until(t_end=t_end)
    assert motions.keys(mug) == before and loaded.r5dgs.t_end == 1.0


def test_a_curve_that_has_lost_all_keys_holds_and_the_others_get_fewer(blender, loaded, mug):
    curve = motions.curves(mug)["location", 2]
    for point in list(curve.keyframe_points)[::-1]:
        curve.keyframe_points.remove(point)
    mug.location[2] = 0.3
    assert blender.ops.r5dgs.simplify_keys(tolerance=1e-3) == {"FINISHED"}
    assert motions.curves(mug)["location", 2].evaluate(20.0) == pytest.approx(0.3)


def test_a_channel_without_keys_starts_the_new_motion_at_its_current_value(blender, loaded, mug):
    curve = motions.curves(mug)["location", 2]
    for point in list(curve.keyframe_points)[::-1]:
        curve.keyframe_points.remove(point)
    mug.location[2] = 0.3
    blender.ops.r5dgs.re_extrapolate()
    assert motions.curves(mug)["location", 2].evaluate(LAST) == pytest.approx(0.3)


def test_rates_of_single_kinds_are_edited_in_seconds_and_kept(blender, loaded, mug):
    physics, state = importlib.import_module("r5dgs.r5dgs_addon.motion.physics"), mug.r5dgs_motion
    factor = blender.context.scene.render.fps / state.frames_per_unit  # units of time per second
    learned = physics.model(mug)
    for kind, name, value, stored in (
        ("drag", "damping", 0.5, 0.5 / factor),
        ("friction", "stop_time", 2.0, 2.0 * factor),
        ("bounce", "bounce_time", 0.5, 0.5 * factor),
        ("bounce", "restitution", 0.8, 0.8),
        ("precession", "precession", (0.1, 0.2, 0.3), np.array((0.1, 0.2, 0.3)) / factor),
        ("two_oscillations", "second_velocity", (1, 0, 0), np.array((1, 0, 0)) / factor),
        ("two_oscillations", "second_frequency", 1.0, 2 * np.pi / factor),
    ):
        before = physics.is_written(mug)
        state.kind = kind
        setattr(state, name, value)
        np.testing.assert_allclose(getattr(physics.model(mug), name), stored, rtol=1e-6)
        np.testing.assert_allclose(getattr(state, name), value, rtol=1e-6)
        assert name in physics.edited(state) and not physics.is_written(mug)
        assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"} and physics.is_written(mug)
        assert blender.ops.r5dgs.reset_motion() == {"FINISHED"} and not physics.edited(state)
        assert physics.model(mug).kind == learned.kind and before
        blender.ops.r5dgs.re_extrapolate()
    state.restitution = 7.0
    assert state.restitution == 1.0
    state.damping = -1.0
    assert state.damping == 0.0

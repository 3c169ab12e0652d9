"""Objects are copied and removed as a whole and take over other motions; other data is kept."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

T_MAX = scenes.T_MAX
KINDS = ("objects", "pointclouds", "actions", "collections", "meshes", "materials", "node_groups")


def anchor(bpy, name):
    return bpy.data.objects[f"{name} anchor"]


def path_of(bpy, collection, obj, times):
    """Places [T, 3] and rotations [T, 3, 3] of an object."""
    found = []
    for t in times:
        motions.go_to(bpy, collection, t)
        found.append(motions.matrix(bpy, obj))
    found = np.array(found)
    return found[:, :3, 3], found[:, :3, :3]


TIMES = (0.0, 0.21, 0.5, T_MAX, 0.83, 1.0)


@pytest.mark.parametrize("stays, index", [("FIRST", 0), ("LAST", 3)])
def test_an_object_moves_as_another_does_about_its_own_pivot(blender, loaded, stays, index):
    mug, car = anchor(blender, "mug"), anchor(blender, "toy car")
    source = path_of(blender, loaded, mug, TIMES)
    before = path_of(blender, loaded, car, TIMES)
    motions.choose(blender, car, mug)
    assert blender.ops.r5dgs.replace_motion(stays=stays) == {"FINISHED"}
    places, turns = path_of(blender, loaded, car, TIMES)
    np.testing.assert_allclose(places - before[0][index], source[0] - source[0][index], atol=1e-5)
    since = source[1] @ source[1][index].T
    np.testing.assert_allclose(turns, since @ before[1][index], atol=2e-5)
    for now, then in zip(path_of(blender, loaded, mug, TIMES), source, strict=True):
        np.testing.assert_array_equal(now, then)
    assert car.animation_data.action != mug.animation_data.action


def test_the_copied_motion_continues_as_physics_and_can_be_reset(blender, scene_path, loaded):
    mug, car = anchor(blender, "mug"), anchor(blender, "toy car")
    motions.choose(blender, car, mug)
    blender.ops.r5dgs.replace_motion()
    assert car.r5dgs_motion.kind == mug.r5dgs_motion.kind
    np.testing.assert_allclose(car.r5dgs_motion.velocity, mug.r5dgs_motion.velocity)
    blender.ops.r5dgs.extrapolate_until(t_end=1.5)
    mine, its = (path_of(blender, loaded, obj, (T_MAX, 1.4))[0] for obj in (car, mug))
    np.testing.assert_allclose(mine[1] - mine[0], its[1] - its[0], atol=1e-5)
    motions.choose(blender, car)
    blender.ops.r5dgs.reset_motion(observed=True)
    motions.assert_plays_like_the_core(blender, loaded, scene_file.read(scene_path), TIMES)


def test_the_motion_of_a_still_object_can_be_copied(blender, loaded):
    block, mug = anchor(blender, "wooden block"), anchor(blender, "mug")
    motions.choose(blender, mug, block)
    blender.ops.r5dgs.replace_motion()
    assert not motions.curves(mug)
    places, turns = path_of(blender, loaded, mug, TIMES)
    np.testing.assert_array_equal(places, np.repeat(places[:1], len(TIMES), axis=0))
    np.testing.assert_array_equal(turns, np.repeat(turns[:1], len(TIMES), axis=0))


def test_a_shadow_follows_the_new_motion_of_its_caster(blender, loaded):
    shadow, mug, car = blender.data.objects["mug shadow anchor"], anchor(blender, "mug"), anchor(blender, "toy car")
    motions.choose(blender, mug, car)
    blender.ops.r5dgs.replace_motion()
    moved, dragged = (path_of(blender, loaded, obj, (T_MAX, 1.0))[0] for obj in (mug, shadow))
    np.testing.assert_allclose(
        (dragged[1] - dragged[0])[:2], (moved[1] - moved[0])[:2] + [0.3 * (moved[1] - moved[0])[2], 0], atol=1e-5
    )
    motions.choose(blender, car, shadow)
    with pytest.raises(RuntimeError, match="follows 'mug anchor'"):
        blender.ops.r5dgs.replace_motion()


def test_nothing_changes_if_the_shadow_cannot_follow(blender, loaded):
    shadow, mug, car = blender.data.objects["mug shadow anchor"], anchor(blender, "mug"), anchor(blender, "toy car")
    shadow.rotation_mode, before = "XYZ", motions.keys(mug)
    motions.choose(blender, mug, car)
    with pytest.raises(RuntimeError, match="mug shadow anchor.*Quaternion"):
        blender.ops.r5dgs.replace_motion()
    assert motions.keys(mug) == before and not mug.r5dgs_motion.taken


def test_rotation_curves_with_keys_at_different_frames_are_refused_and_nothing_changes(blender, loaded):
    mug, car = anchor(blender, "mug"), anchor(blender, "toy car")
    curve = motions.curves(mug)["rotation_quaternion", 2]
    curve.keyframe_points.remove(curve.keyframe_points[1])
    before = motions.keys(car)
    motions.choose(blender, car, mug)
    with pytest.raises(RuntimeError, match="different frames"):
        blender.ops.r5dgs.replace_motion(stays="FIRST")
    assert motions.keys(car) == before


def test_a_duplicate_moves_the_same_way_independently(blender, loaded):
    mug, cloud = anchor(blender, "mug"), blender.data.objects["mug"]
    motions.choose(blender, mug)
    assert blender.ops.r5dgs.duplicate_object(offset=(1.0, 2.0, 3.0)) == {"FINISHED"}
    twin, shadow = blender.data.objects["mug anchor.001"], blender.data.objects["mug shadow anchor.001"]
    copy = blender.data.objects["mug.001"]
    assert blender.context.view_layer.objects.active == twin and not mug.select_get()
    assert twin.users_collection[0] == copy.users_collection[0] != mug.users_collection[0]
    assert twin.users_collection[0].name in loaded.children
    assert twin.animation_data.action != mug.animation_data.action and copy.data == cloud.data
    assert shadow.r5dgs_motion.leader == twin and twin.r5dgs.motion_id == mug.r5dgs.motion_id
    for t in TIMES:
        motions.go_to(blender, loaded, t)
        here, there = motions.points(blender, cloud), motions.points(blender, copy)
        np.testing.assert_allclose(there, here + [1.0, 2.0, 3.0], atol=2e-6)
    before = motions.keys(mug)
    motions.choose(blender, twin)
    twin.r5dgs_motion.velocity = (5.0, 0.0, 0.0)
    blender.ops.r5dgs.re_extrapolate()
    assert motions.keys(mug) == before and motions.keys(twin) != before


def test_a_duplicate_is_placed_beside_the_original_by_default(blender, loaded):
    motions.choose(blender, blender.data.objects["red apple"])  # its selected cloud selects the object
    blender.ops.r5dgs.duplicate_object()
    a, b = (motions.points(blender, blender.data.objects[name]) for name in ("red apple", "red apple.001"))
    assert b[:, 0].min() > a[:, 0].max()


def test_deleting_a_duplicate_leaves_everything_as_it_was(blender, loaded):
    before = {kind: {data.name for data in getattr(blender.data, kind)} for kind in KINDS}
    motions.choose(blender, anchor(blender, "mug"), anchor(blender, "toy car"))
    blender.ops.r5dgs.duplicate_object()
    blender.ops.r5dgs.show_confidence()
    assert blender.ops.r5dgs.delete_object() == {"FINISHED"}
    assert {kind: {data.name for data in getattr(blender.data, kind)} for kind in KINDS} == before


def test_deleting_removes_only_the_parts_of_the_object(blender, scene_path, loaded):
    mug = anchor(blender, "mug")
    lamp = blender.data.objects.new("lamp", blender.data.lights.new("lamp", "POINT"))
    loaded.objects.link(lamp)
    lamp.parent = mug
    blender.context.view_layer.update()
    place = motions.matrix(blender, lamp)
    cloud_of_mug = blender.data.objects["mug"].data.name
    others = {o.name for o in loaded.all_objects} - {"mug anchor", "mug", "mug shadow anchor", "mug shadow"}
    gone = [o.r5dgs.motion_id for o in (mug, blender.data.objects["mug shadow anchor"])]
    motions.choose(blender, blender.data.objects["mug"])
    assert blender.ops.r5dgs.delete_object() == {"FINISHED"}
    assert {o.name for o in loaded.all_objects} == others
    assert "mug" not in blender.data.collections and cloud_of_mug not in blender.data.pointclouds
    np.testing.assert_allclose(motions.matrix(blender, lamp), place, atol=1e-6)
    motions.assert_plays_like_the_core(blender, loaded, scene_file.read(scene_path), (0.3, 0.9), gone)


@pytest.mark.parametrize("name", ["background", "mug"])
def test_clouds_that_move_with_another_object_are_selected_with_their_own_object(blender, tmp_path, name):
    """Selecting clouds that move with another object does not select that object."""
    scene = scenes.make_scene(n=400, objects=5, seed=1)
    motion_ids = scene.gaussians.motion_ids.copy()
    motion_ids[np.flatnonzero((scene.gaussians.object_ids == 0) & (motion_ids == 0))[-5:]] = (
        2  # background that moves with the apple
    )
    motion_ids[np.flatnonzero(scene.gaussians.object_ids == 1)[-5:]] = 3  # of the mug, moving with the car
    order = np.lexsort((motion_ids, scene.gaussians.object_ids))
    fields = ("means", "quats", "log_scales", "opacity_logits", "sh", "identities", "shading", "object_ids")
    arrays = {field: scene.arrays()[field][order] for field in fields}
    scene = scene.with_arrays(**arrays, motion_ids=motion_ids[order])
    path = scene_file.write(scene, tmp_path / "fringe.r5dgs")
    motions.load(blender, path)
    blender.ops.r5dgs.select_by_prompt(text=name)
    selected = blender.context.selected_objects
    assert any(obj.parent is not None and obj.parent not in selected for obj in selected if obj.r5dgs.role == "CLOUD")
    meant = motions.addon("motion.duplicate_delete").chosen(blender.context)
    assert meant and {obj.r5dgs.object_id for obj in meant} == {anchor(blender, name).r5dgs.object_id}
    blender.ops.r5dgs.delete_object()
    blender.ops.r5dgs.select_by_prompt(text=name)  # its remaining clouds move with other objects
    assert blender.context.selected_objects and not motions.addon("motion.duplicate_delete").chosen(blender.context)


def test_shadows_are_kept_on_request(blender, loaded):
    motions.choose(blender, anchor(blender, "mug"))
    blender.ops.r5dgs.delete_object(shadows=False)
    shadow = blender.data.objects["mug shadow anchor"]
    assert shadow.r5dgs_motion.leader is None
    motions.choose(blender, shadow)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}  # it keeps its last position


def test_a_rotated_duplicate_keeps_its_rotation(blender, loaded):
    """Copying a motion that is rotated at the reference frame mixes the four components of the quaternion."""
    mug, car = anchor(blender, "mug"), anchor(blender, "toy car")
    turn = rotations.rotvecs_to_quats(np.array([0.3, -0.2, 1.0]))
    for index in range(4):
        curve = motions.curves(car)["rotation_quaternion", index]
        motions.addon("compat").fcurves(car).remove(curve)
    car.rotation_quaternion = turn
    motions.go_to(blender, loaded, T_MAX)
    before = motions.matrix(blender, car)
    motions.choose(blender, car, mug)
    blender.ops.r5dgs.replace_motion()
    places, turns = path_of(blender, loaded, mug, TIMES)
    _, mine = path_of(blender, loaded, car, TIMES)
    np.testing.assert_allclose(mine[3], before[:3, :3], atol=1e-5)
    np.testing.assert_allclose(mine, turns @ turns[3].T @ before[:3, :3], atol=2e-5)

"""Hand-over to Blender's rigid bodies and back: velocities, collisions with meshes, keys, and what is left behind."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import knots
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

KINDS = ("objects", "meshes", "collections", "actions")


def make_thrown(path, contact=False):
    """Write a scene with a thrown and a sliding object; with contact, the thrown one stops in the air."""
    scene = scenes.make_scene(n=400, objects=2, shadows=False)
    thrown = MotionModel(
        "ballistic_spin",
        velocity=[0.5, 0.2, 1.0],
        acceleration=[0, 0, -3.0],
        angular_velocity=[0, 0, 2.0],
        offset_displacement=[0.002, 0, 0.001],
        radius=0.3,
    )
    group = dataclasses.replace(scene.groups[1], model=thrown)
    if contact:
        none = np.zeros((1, 3))
        rest = knots.pack(np.zeros(1), (np.array([[1.0, 0, 0, 0]]), none), (none, none), (none, none))
        group = dataclasses.replace(group, model=MotionModel("trajectory", knots=rest, radius=0.3), smooth=thrown)
    groups = (scene.groups[0], group, *scene.groups[2:])
    row = {"name": "contact", "object_id": group.object_id, "friction": 0.2, "restitution": 0.7}
    needs = (row,) if contact else ()
    return scene_file.write(dataclasses.replace(scene, groups=groups, needs=needs), path)


@pytest.fixture(scope="module")
def thrown_scene(tmp_path_factory):
    return make_thrown(tmp_path_factory.mktemp("thrown") / "thrown.r5dgs")


@pytest.fixture
def thrown(blender, thrown_scene):
    """Collection of that scene with both objects selected."""
    collection = motions.load_again(blender, thrown_scene)
    motions.choose(blender, blender.data.objects["red apple anchor"], blender.data.objects["mug anchor"])
    return collection


def release(collection):
    state = collection.r5dgs
    return int(np.floor(state.frame_zero + state.t_max * state.frames_per_unit + 1e-6))


def play(bpy, names, first, last):
    """World matrices of objects at frames, played one after another from the start. [F, A, 4, 4]"""
    found = []
    for frame in range(min(first, bpy.context.scene.frame_start), last + 1):
        bpy.context.scene.frame_set(frame)
        if frame >= first:
            found.append([motions.matrix(bpy, bpy.data.objects[name]) for name in names])
    return np.array(found)


def counts(bpy):
    return {kind: sorted(data.name for data in getattr(bpy.data, kind)) for kind in KINDS}


def add_ramp(bpy, place):
    """A steep passive plate that faces -x."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=place, rotation=(0, 1.2, 0), scale=(2, 2, 0.05))
    bpy.ops.rigidbody.object_add(type="PASSIVE")
    return bpy.context.object


def test_bodies_start_with_the_learned_velocity_and_fly_on_as_learned(blender, thrown):
    bpy, frame = blender, release(thrown)
    learned = play(bpy, ["mug anchor", "red apple anchor"], frame, frame + 12)
    assert bpy.ops.r5dgs.hand_over() == {"FINISHED"}
    free = play(bpy, ["mug anchor", "red apple anchor"], frame, frame + 12)
    np.testing.assert_allclose(free[0], learned[0], atol=1e-5)
    model = MotionModel("translation", velocity=[0.5, 0.2, 1.0], acceleration=[0, 0, -3.0])
    per = thrown.r5dgs.frames_per_unit
    start = free[1, 0, :3, 3] - free[0, 0, :3, 3] - 0.5 * model.acceleration / per**2
    np.testing.assert_allclose(start, model.velocity / per, atol=0.01 * np.linalg.norm(model.velocity) / per)
    turn = free[1, 0, :3, :3] @ free[0, 0, :3, :3].T
    assert np.arcsin((turn[1, 0] - turn[0, 1]) / 2) == pytest.approx(2.0 / per, rel=0.01)
    # The centre of the hull is not the pivot, and the learned pose corrects an offset: a per cent of the size remains.
    np.testing.assert_allclose(free[:, 0, :3, 3], learned[:, 0, :3, 3], atol=0.02 * 0.6)


def test_the_motion_up_to_the_release_is_unchanged(blender, thrown):
    bpy, frame = blender, 20
    bpy.context.scene.frame_set(frame)
    before = play(bpy, ["mug anchor", "red apple anchor"], 1, frame)
    assert bpy.ops.r5dgs.hand_over(start="CURRENT") == {"FINISHED"}
    after = play(bpy, ["mug anchor", "red apple anchor"], 1, frame)
    np.testing.assert_allclose(after, before, atol=2e-6)


def test_a_ramp_deflects_bodies_and_baked_keys_play_what_was_simulated(blender, thrown):
    bpy, frame = blender, release(thrown)
    bpy.context.scene.frame_end = frame + 60
    names, former = ["mug anchor", "red apple anchor"], counts(bpy)
    gravity = tuple(bpy.context.scene.gravity)
    observed = play(bpy, names, 1, frame)
    assert bpy.ops.r5dgs.hand_over() == {"FINISHED"}
    free = play(bpy, names, frame, frame + 60)
    ramp = add_ramp(bpy, (1.6, 0.1, 0.5))
    hit = play(bpy, names, frame, frame + 60)
    assert np.abs(hit[-1, :, :3, 3] - free[-1, :, :3, 3]).max() > 0.1
    assert bpy.ops.r5dgs.bake_back() == {"FINISHED"}
    baked = play(bpy, names, frame, frame + 60)
    size = 0.6
    corners = 0.3 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for a, b in zip(baked.reshape(-1, 4, 4), hit.reshape(-1, 4, 4), strict=True):
        apart = corners @ (a - b)[:3, :3].T + (a - b)[:3, 3]
        assert np.linalg.norm(apart, axis=1).max() < 1e-3 * size
    np.testing.assert_allclose(play(bpy, names, 1, frame), observed, atol=2e-6)
    for name in names:
        anchor = bpy.data.objects[name]
        assert not anchor.constraints
        assert max(len(curve.keyframe_points) for curve in motions.curves(anchor).values()) < 80
    assert bpy.context.scene.rigidbody_world is not None and ramp.rigid_body is not None
    ramp.name = ramp.data.name = "ramp"
    left = counts(bpy)
    assert set(left["objects"]) - set(former["objects"]) == {"ramp"}
    assert set(left["meshes"]) - set(former["meshes"]) == {"ramp"}
    assert tuple(bpy.context.scene.gravity) == gravity


def test_nothing_is_left_behind_by_bake_and_by_refusals(blender, thrown):
    bpy = blender
    former, gravity = counts(bpy), tuple(bpy.context.scene.gravity)
    bpy.context.scene.frame_end = release(thrown)
    bpy.ops.r5dgs.hand_over()
    with pytest.raises(RuntimeError, match="set an end after the release"):
        bpy.ops.r5dgs.bake_back()
    with pytest.raises(RuntimeError, match="Bake the rigid bodies back to keys first"):
        bpy.ops.r5dgs.hand_over()
    bpy.context.scene.frame_end += 5
    bpy.ops.r5dgs.bake_back()
    assert counts(bpy) == former and bpy.context.scene.rigidbody_world is None
    assert tuple(bpy.context.scene.gravity) == gravity


def test_objects_without_a_hull_or_a_motion_of_their_own_are_refused(blender, thrown, scene_path):
    bpy = blender
    former = counts(bpy)
    cloud = next(obj for obj in motions.clouds(thrown) if obj.name == "mug")
    cloud["r5dgs_hull"] = [0.0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0]
    with pytest.raises(RuntimeError, match="mug anchor: expected enough Gaussians for a hull"):
        bpy.ops.r5dgs.hand_over()
    assert counts(bpy) == former and bpy.context.scene.rigidbody_world is None
    other = motions.load_again(bpy, scene_path)
    shadow = next(obj for obj in other.all_objects if obj.name.startswith("mug shadow anchor"))
    motions.choose(bpy, shadow)
    with pytest.raises(RuntimeError, match="a motion of its own, found none"):
        bpy.ops.r5dgs.hand_over()


def test_shadows_follow_baked_objects(blender, loaded):
    bpy, frame = blender, release(loaded)
    bpy.context.scene.frame_end = frame + 5
    motions.choose(bpy, bpy.data.objects["mug anchor"])
    bpy.ops.r5dgs.hand_over()
    bpy.ops.r5dgs.bake_back()
    moved = play(bpy, ["mug anchor", "mug shadow anchor"], frame, frame + 5)[:, :, :3, 3]
    follow = np.diag([1.0, 1.0, 0.0])
    follow[0, 2] = 0.3
    np.testing.assert_allclose(moved[:, 1] - moved[0, 1], (moved[:, 0] - moved[0, 0]) @ follow.T, atol=1e-4)


def test_bodies_with_contacts_fall_with_the_gravity_of_their_smooth_motion(blender, tmp_path):
    bpy = blender
    motions.load_again(bpy, make_thrown(tmp_path / "contact.r5dgs", contact=True))
    motions.choose(bpy, bpy.data.objects["mug anchor"])
    assert bpy.ops.r5dgs.hand_over() == {"FINISHED"}
    fps = bpy.context.scene.render.fps
    np.testing.assert_allclose(bpy.context.scene.gravity, np.array([0, 0, -3.0]) * (fps / 60) ** 2, rtol=1e-5)


@pytest.mark.parametrize("ticked", [False, True])
def test_bodies_with_contacts_have_the_fitted_material_or_that_of_the_panel(blender, tmp_path, ticked):
    bpy = blender
    motions.load_again(bpy, make_thrown(tmp_path / "contact.r5dgs", contact=True))
    mug, apple = (bpy.data.objects[name] for name in ("mug anchor", "red apple anchor"))
    assert mug.r5dgs_contact.friction == pytest.approx(0.2)
    mug.r5dgs_contact.use_friction, mug.r5dgs_contact.friction = ticked, 0.9
    motions.choose(bpy, mug, apple)
    assert bpy.ops.r5dgs.hand_over() == {"FINISHED"}
    found = {name: bpy.data.objects[f"{name} proxy"].rigid_body for name in ("mug", "red apple")}
    assert (found["mug"].friction, found["mug"].restitution) == pytest.approx((0.9 if ticked else 0.2, 0.7))
    assert (found["red apple"].friction, found["red apple"].restitution) == (0.5, 0.0)  # Blender's own


def test_bodies_move_past_the_former_end_of_the_cache_and_its_range_is_restored(blender, thrown):
    bpy, scene, frame = blender, blender.context.scene, release(thrown)
    bpy.ops.rigidbody.world_add()
    cache = scene.rigidbody_world.point_cache
    cache.frame_start, cache.frame_end = frame, frame + 3
    scene.frame_end = frame + 4
    bpy.ops.r5dgs.hand_over()
    scene.frame_end = frame + 20
    bpy.ops.r5dgs.bake_back()
    late = play(bpy, ["mug anchor"], frame + 10, frame + 20)[:, 0, :2, 3]
    assert np.linalg.norm(np.diff(late, axis=0), axis=1).min() > 0.1 / thrown.r5dgs.frames_per_unit
    assert (cache.frame_start, cache.frame_end) == (frame, frame + 3)


def test_proxies_of_another_blender_scene_are_left_alone(blender, thrown):
    bpy, frame = blender, release(thrown)
    apple, target = bpy.data.objects["red apple anchor"], bpy.data.objects.new("pose", None)
    other, proxies = bpy.data.scenes.new("other"), bpy.data.collections.new("proxies")
    other.collection.children.link(proxies)
    proxies.objects.link(target)
    hand_over = motions.addon("motion.hand_over")
    proxies[hand_over.FRAME] = frame
    constraint = apple.constraints.new("COPY_TRANSFORMS")
    constraint.name, constraint.target, constraint.influence = hand_over.NAME, target, 0.0
    keys = motions.keys(apple)
    with pytest.raises(RuntimeError, match="red apple anchor: it is a rigid body in another Blender scene"):
        bpy.ops.r5dgs.hand_over()
    motions.choose(bpy, bpy.data.objects["mug anchor"])
    bpy.context.scene.frame_end = frame + 3
    bpy.ops.r5dgs.hand_over()
    bpy.ops.r5dgs.bake_back()
    assert not bpy.data.objects["mug anchor"].constraints
    assert apple.constraints[hand_over.NAME].target == target and motions.keys(apple) == keys


@pytest.mark.parametrize("with_objects", [True, False])
def test_what_a_deleted_hand_over_has_left_is_removed_by_the_next(blender, thrown, with_objects):
    bpy, scene = blender, blender.context.scene
    former, gravity = counts(bpy), tuple(scene.gravity)
    scene.frame_end = release(thrown) + 2
    bpy.ops.r5dgs.hand_over()
    proxies = motions.addon("motion.hand_over").proxies_of(scene)
    objects = list(proxies.objects)
    for obj in objects:
        scene.collection.objects.link(obj)
    bpy.data.batch_remove([proxies, *(objects if with_objects else ())])
    motions.choose(bpy, bpy.data.objects["mug anchor"])
    bpy.ops.r5dgs.hand_over()
    assert "R5DGS Rigid Bodies" not in bpy.data.objects["red apple anchor"].constraints
    bpy.ops.r5dgs.bake_back()
    assert tuple(scene.gravity) == gravity and scene.rigidbody_world is None
    left = counts(bpy)
    kinds = ("objects", "collections") if with_objects else KINDS  # meshes of objects that the user deleted
    assert [left[kind] for kind in kinds] == [former[kind] for kind in kinds]

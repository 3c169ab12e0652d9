"""Pivot and axis of a motion are shown and edited in every kind that has them."""

import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes

T_MAX = scenes.T_MAX
LAST = 1 + 60 * T_MAX
TIMES = (T_MAX, 0.7613, 0.83, 0.9111, 1.0)
PIVOT = np.array([0.4, -0.3, 0.9])


@pytest.fixture
def loaded(blender, scene_path):
    """A scene whose root was moved, turned and scaled."""
    collection = motions.load_again(blender, scene_path)
    root = collection.r5dgs.root
    root.location, root.scale = (3.0, -1.0, 2.0), (2.0, 2.0, 2.0)
    root.rotation_mode, root.rotation_quaternion = "QUATERNION", (0.6, 0.0, 0.8, 0.0)
    blender.context.view_layer.update()
    return collection


def set_up(state, kind, **fields):
    """Give fields in units of Blender's time."""
    zero = (0.0, 0.0, 0.0)
    rates = dict.fromkeys(("velocity", "acceleration", "angular_velocity", "angular_acceleration"), zero)
    state.kind, state.frequency = kind, 0.0
    for name, value in {**rates, **fields}.items():
        setattr(state, name, value)


SPIN = {"angular_velocity": (0.5, -1.0, 2.0), "angular_acceleration": (0.2, 0.1, -0.4)}
KINDS = {
    "hinge": ("ballistic_spin", SPIN),
    "pendulum": ("ballistic_spin", {"angular_velocity": (0.5, -1.0, 2.0), "frequency": 1.5}),
    "turn": ("constant_twist", {"angular_velocity": (0.5, -1.0, 2.0)}),
    "orbit": ("world_twist", SPIN),
}


def body_point(bpy, collection, anchor, place):
    """Point of the body at a position at t_max in the root's frame, in the anchor's own frame. [4]"""
    motions.go_to(bpy, collection, T_MAX)
    world = motions.matrix(bpy, collection.r5dgs.root) @ [*place, 1.0]
    return np.linalg.solve(motions.matrix(bpy, anchor), world)


def paths(bpy, collection, anchor, *points):
    """Trajectories of points of the body in the root's axes. [n, T, 3]"""
    found = []
    for t in TIMES:
        motions.go_to(bpy, collection, t)
        there = np.linalg.solve(motions.matrix(bpy, collection.r5dgs.root), motions.matrix(bpy, anchor))
        found.append([(there @ point)[:3] for point in points])
    return np.swapaxes(found, 0, 1)


@pytest.mark.parametrize("name", KINDS)
def test_the_point_that_the_pivot_was_moved_to_stays_and_others_turn(blender, loaded, mug, name):
    kind, fields = KINDS[name]
    for (path, index), curve in motions.curves(mug).items():  # the user has moved it
        for point in curve.keyframe_points if path == "location" else ():
            point.co_ui = (point.co[0], point.co[1] + (0.5, -0.25, 0.125)[index])
    before = motions.keys(mug, LAST)
    set_up(mug.r5dgs_motion, kind, **fields)
    mug.r5dgs_pivot.point = PIVOT
    np.testing.assert_allclose(mug.r5dgs_pivot.point, PIVOT, atol=1e-5)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    assert motions.keys(mug, LAST) == before
    inside = [body_point(blender, loaded, mug, place) for place in (PIVOT, PIVOT + [0.0, 0.5, 0.0])]
    still, turns = paths(blender, loaded, mug, *inside)
    np.testing.assert_allclose(still, np.broadcast_to(PIVOT, still.shape), atol=1e-4)
    assert np.ptp(turns, axis=0).max() > 0.1


@pytest.mark.parametrize("name", ["pendulum", "turn"])
def test_points_on_a_set_axis_stay_fixed(blender, loaded, mug, name):
    kind, fields = KINDS[name]
    set_up(mug.r5dgs_motion, kind, **fields)
    mug.r5dgs_pivot.point = PIVOT
    mug.r5dgs_pivot.axis = (0.0, 3.0, 4.0)
    np.testing.assert_allclose(mug.r5dgs_pivot.axis, [0.0, 0.6, 0.8], atol=1e-6)
    np.testing.assert_allclose(mug.r5dgs_pivot.point, PIVOT, atol=1e-5)
    assert np.linalg.norm(mug.r5dgs_motion.angular_velocity) == pytest.approx(np.linalg.norm((0.5, -1.0, 2.0)))
    blender.ops.r5dgs.re_extrapolate()
    places = [PIVOT + share * np.array([0.0, 0.6, 0.8]) for share in (-1.0, 0.0, 2.0)]
    inside = [body_point(blender, loaded, mug, place) for place in places]
    for place, path in zip(places, paths(blender, loaded, mug, *inside), strict=True):
        np.testing.assert_allclose(path, np.broadcast_to(place, path.shape), atol=1e-4)


def test_a_spring_swings_about_its_pivot(blender, loaded, mug):
    set_up(mug.r5dgs_motion, "translation", velocity=(0.3, 0.0, -1.0), frequency=4.0)
    motions.go_to(blender, loaded, T_MAX)
    np.testing.assert_allclose(mug.r5dgs_pivot.point, mug.location, atol=1e-5)  # no acceleration: it starts at rest
    mug.r5dgs_pivot.point = PIVOT
    blender.ops.r5dgs.re_extrapolate()
    half = 0.5 / 4.0 * blender.context.scene.render.fps  # frames of half a swing
    for frame in (LAST, LAST + 3, LAST + 7):
        places = []
        for at in (frame, frame + half):
            motions.go_to(blender, loaded, (at - 1) / 60)
            places.append(np.array(mug.location))
        np.testing.assert_allclose(np.mean(places, axis=0), PIVOT, atol=1e-4)


def test_reading_edits_nothing_and_reset_restores_the_learned_pivot(blender, scene_path, loaded, mug):
    physics = motions.addon("motion.physics")
    learned = scene_file.read(scene_path).groups[1]
    motions.go_to(blender, loaded, T_MAX)
    before = tuple(mug.r5dgs_pivot.point)
    np.testing.assert_allclose(before, np.array(mug.location) + learned.model.center_offset, atol=1e-5)
    assert not physics.edited(mug.r5dgs_motion) and physics.is_written(mug)
    mug.r5dgs_pivot.point = PIVOT
    assert physics.edited(mug.r5dgs_motion) == {"center_offset"} and not physics.is_written(mug)
    blender.ops.r5dgs.re_extrapolate()
    blender.ops.r5dgs.reset_motion()
    assert tuple(mug.r5dgs_pivot.point) == before and not physics.edited(mug.r5dgs_motion)
    loaded.r5dgs.root.matrix_world.identity()
    loaded.r5dgs.root.location, loaded.r5dgs.root.scale = (0, 0, 0), (1, 1, 1)
    loaded.r5dgs.root.rotation_quaternion = (1, 0, 0, 0)
    motions.assert_plays_like_the_core(blender, loaded, scene_file.read(scene_path), TIMES)


def test_the_3d_cursor_becomes_the_pivot_and_can_be_undone(blender, loaded, mug):
    set_up(mug.r5dgs_motion, "constant_twist", angular_velocity=(0.0, 0.0, 2.0))
    mug.r5dgs_motion.at_once = True
    before = tuple(mug.r5dgs_pivot.point)
    world = motions.matrix(blender, loaded.r5dgs.root)
    blender.context.scene.cursor.location = (world @ [*PIVOT, 1.0])[:3]
    blender.ops.ed.undo_push(message="before")
    blender.ops.ed.undo_push(message="before")
    assert blender.ops.r5dgs.pivot_to_cursor() == {"FINISHED"}
    np.testing.assert_allclose(mug.r5dgs_pivot.point, PIVOT, atol=1e-5)
    assert motions.addon("motion.physics").is_written(mug)
    written = motions.keys(mug)
    blender.ops.ed.undo_push(message="pivot")
    blender.ops.ed.undo()
    mug = blender.data.objects["mug anchor"]
    assert tuple(mug.r5dgs_pivot.point) == before and motions.keys(mug) != written
    blender.ops.ed.redo()
    mug = blender.data.objects["mug anchor"]
    np.testing.assert_allclose(mug.r5dgs_pivot.point, PIVOT, atol=1e-5)
    assert motions.keys(mug) == written


def test_the_3d_cursor_becomes_the_pivot_of_an_object_parented_to_a_bone(blender, loaded, mug):
    rig = blender.data.objects.new("rig", blender.data.armatures.new("rig"))
    blender.context.scene.collection.objects.link(rig)
    rig.location, rig.rotation_euler = (0.5, 1.0, -0.5), (0.3, 0.2, 0.9)
    motions.choose(blender, rig)
    blender.ops.object.mode_set(mode="EDIT")
    bone = rig.data.edit_bones.new("hand")
    bone.head, bone.tail = (1, 0, 0), (1, 2, 1)
    blender.ops.object.mode_set(mode="OBJECT")
    mug.parent, mug.parent_type, mug.parent_bone = rig, "BONE", "hand"
    motions.go_to(blender, loaded, T_MAX)
    motions.choose(blender, mug)
    set_up(mug.r5dgs_motion, *KINDS["hinge"][:1], **SPIN)
    blender.context.scene.cursor.location = PIVOT
    assert blender.ops.r5dgs.pivot_to_cursor() == {"FINISHED"}
    blender.ops.r5dgs.re_extrapolate()
    there = np.linalg.solve(motions.matrix(blender, mug), [*PIVOT, 1.0])
    for t in TIMES:
        motions.go_to(blender, loaded, t)
        np.testing.assert_allclose((motions.matrix(blender, mug) @ there)[:3], PIVOT, atol=1e-4)


def test_the_pivot_of_a_copy_moves_with_the_copy(blender, loaded, mug):
    set_up(mug.r5dgs_motion, *KINDS["hinge"][:1], **SPIN)
    mug.r5dgs_pivot.point = PIVOT
    blender.ops.r5dgs.duplicate_object(offset=(1.0, 2.0, 0.0))
    copy = motions.addon("motion.duplicate_delete").active_anchor(blender.context)
    np.testing.assert_allclose(copy.r5dgs_pivot.point, PIVOT + [1.0, 2.0, 0.0], atol=1e-5)
    copy.r5dgs_pivot.point = PIVOT
    blender.ops.r5dgs.re_extrapolate()
    (still,) = paths(blender, loaded, copy, body_point(blender, loaded, copy, PIVOT))
    np.testing.assert_allclose(still, np.broadcast_to(PIVOT, still.shape), atol=1e-4)


def test_export_writes_the_moved_pivot(blender, scene_path, tmp_path):
    collection = motions.load(blender, scene_path)
    mug = blender.data.objects["mug anchor"]
    motions.choose(blender, mug)
    set_up(mug.r5dgs_motion, "ballistic_spin", angular_velocity=(0.0, 0.0, 2.0))
    mug.r5dgs_pivot.point = PIVOT
    blender.ops.r5dgs.re_extrapolate()
    out = tmp_path / "edited.r5dgs"
    assert blender.ops.r5dgs.export_scene(filepath=str(out)) == {"FINISHED"}
    scene = scene_file.read(out)
    group = scene.groups[1]
    np.testing.assert_allclose(group.pivot + group.model.center_offset, PIVOT, atol=1e-5)
    quats, displacements = models.evaluate(group.model, np.linspace(0, 1, 5))
    arms = np.broadcast_to(PIVOT - group.pivot, displacements.shape)
    np.testing.assert_allclose(rotations.rotate(quats, arms) + displacements, arms, atol=1e-5)
    motions.assert_plays_like_the_core(blender, collection, scene, TIMES)
    assert (
        np.abs(scene_player.Player(scene).frame(1.0).means - scene_player.Player(scene).frame(T_MAX).means).max() > 0.1
    )


def test_motions_without_a_pivot_show_none(blender, loaded, mug):
    panel = blender.types.R5DGS_PT_motion
    state = mug.r5dgs_motion
    has = {"static": 0, "translation": 0, "ballistic_spin": 2, "constant_twist": 2, "world_twist": 2, "free_top": 0}
    for kind, count in has.items():
        set_up(state, kind, angular_velocity=(0.0, 0.0, 1.0))
        said = layouts.draw(blender, panel)
        assert [name in said for name in ("point", "axis")].count(True) == count, kind
        if not count:
            with pytest.raises(RuntimeError, match="mug anchor.*has no pivot"):
                blender.ops.r5dgs.pivot_to_cursor()
    state.kind, state.frequency = "translation", 1.0
    assert "point" in layouts.draw(blender, panel) and "axis" not in layouts.draw(blender, panel)
    motions.choose(blender, loaded.r5dgs.root)
    with pytest.raises(RuntimeError, match="Select an object"):
        blender.ops.r5dgs.pivot_to_cursor()


def test_nan_and_unreadable_curves_do_no_harm(blender, loaded, mug):
    panel = blender.types.R5DGS_PT_motion
    state = mug.r5dgs_motion
    set_up(state, "world_twist", **SPIN)
    before = [tuple(getattr(state, name)) for name in ("velocity", "angular_velocity")]
    mug.r5dgs_pivot.point = mug.r5dgs_pivot.axis = (np.nan, 0.0, 0.0)
    mug.r5dgs_pivot.axis = (0.0, 0.0, 0.0)
    assert [tuple(getattr(state, name)) for name in ("velocity", "angular_velocity")] == before
    mug.rotation_mode = "XYZ"
    mug.r5dgs_pivot.point = PIVOT
    assert [tuple(getattr(state, name)) for name in ("velocity", "angular_velocity")] == before
    assert "point" not in layouts.draw(blender, panel)
    with pytest.raises(RuntimeError, match=r"mug anchor.*Quaternion"):
        blender.ops.r5dgs.pivot_to_cursor()


def test_an_extreme_pivot_does_no_harm(blender, loaded, mug):
    set_up(mug.r5dgs_motion, "constant_twist", angular_velocity=(0.5, -1.0, 2.0))
    observed = motions.keys(mug, LAST)
    for far in (1e9, 1e30, np.inf):
        mug.r5dgs_pivot.point = (far, far, 0.0)
        assert np.isfinite(mug.r5dgs_motion.velocity).all()
        assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
        assert motions.keys(mug, LAST) == observed
    blender.ops.r5dgs.reset_motion()
    assert not motions.addon("motion.physics").edited(mug.r5dgs_motion)


@pytest.mark.parametrize("far", [1e9, 1e30])
def test_an_orbit_that_cannot_be_integrated_is_refused_and_nothing_changes(blender, loaded, mug, far):
    set_up(mug.r5dgs_motion, "world_twist", **SPIN)
    mug.r5dgs_pivot.point = (far, far, 0.0)
    before = motions.keys(mug)
    with pytest.raises(RuntimeError, match="mug anchor: the orbit is too fast"):
        blender.ops.r5dgs.re_extrapolate()
    assert motions.keys(mug) == before
    set_up(mug.r5dgs_motion, "world_twist", **SPIN)
    mug.r5dgs_pivot.point = PIVOT
    assert blender.ops.r5dgs.extrapolate_until(t_end=3.0) == {"FINISHED"}

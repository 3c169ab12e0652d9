"""Impossible actions are refused before anything is changed."""

import dataclasses
import math
import shutil

import pytest

from tests.support import scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from tests.support import motions  # noqa: E402

KINDS = ("collections", "objects", "pointclouds", "meshes", "actions", "materials", "node_groups", "images")
LAST = 46  # frame of the last observed time


def fields(anchor):
    """Values of an anchor's physics panel."""
    state = anchor.r5dgs_motion
    return state.kind, tuple(state.velocity), tuple(state.angular_velocity), state.taken


def make_bouncy(anchor):
    """Set an interpolation between keys that cannot be split at the last observed time."""
    anchor.keyframe_insert("location", frame=1)
    for curve in motions.curves(anchor).values():
        for k in reversed(range(len(curve.keyframe_points))):
            if 1.5 < curve.keyframe_points[k].co[0] < LAST + 2:
                curve.keyframe_points.remove(curve.keyframe_points[k])
        curve.keyframe_points.insert(LAST + 10, 1.0)
        for point in curve.keyframe_points:
            point.interpolation = "BOUNCE"


@pytest.mark.parametrize("observed", [False, True], ids=["physics", "observed keys too"])
def test_reset_changes_no_field_if_the_curves_of_a_shadow_cannot_be_split(blender, mug, observed):
    shadow = blender.data.objects["mug shadow anchor"]
    make_bouncy(shadow)
    mug.r5dgs_motion.velocity = (4.0, 5.0, 6.0)
    before = fields(mug), motions.keys(mug), motions.keys(shadow)
    with pytest.raises(RuntimeError, match="mug shadow anchor.*Bounce.*set a key at frame 46"):
        blender.ops.r5dgs.reset_motion(observed=observed)
    assert (fields(mug), motions.keys(mug), motions.keys(shadow)) == before


def test_reset_changes_no_field_if_its_own_curves_cannot_be_split_unless_they_are_replaced(blender, mug):
    make_bouncy(mug)
    mug.r5dgs_motion.velocity = (4.0, 5.0, 6.0)
    before = fields(mug), motions.keys(mug)
    with pytest.raises(RuntimeError, match="mug anchor.*Bounce"):
        blender.ops.r5dgs.reset_motion()
    assert (fields(mug), motions.keys(mug)) == before
    assert blender.ops.r5dgs.reset_motion(observed=True) == {"FINISHED"}
    assert not motions.addon("motion.physics").edited(mug.r5dgs_motion)


def test_reset_of_a_shadow_is_refused_if_its_caster_has_nan_values(blender, mug):
    shadow = blender.data.objects["mug shadow anchor"]
    mug.r5dgs_motion.velocity = (math.nan, 0.0, 0.0)
    shadow.r5dgs_motion.leader = None
    shadow.r5dgs_motion.velocity = (1.0, 0.0, 0.0)
    motions.choose(blender, shadow)
    before = fields(shadow), motions.keys(shadow)
    with pytest.raises(RuntimeError, match="mug anchor: velocity"):
        blender.ops.r5dgs.reset_motion()
    assert (fields(shadow), motions.keys(shadow)) == before and shadow.r5dgs_motion.leader is None


def test_reset_of_two_scenes_changes_neither_if_the_file_of_one_is_damaged(blender, scene_path, loaded, tmp_path):
    other_path = shutil.copy(scene_path, tmp_path / "other.r5dgs")
    other = motions.load(blender, other_path)
    anchors = [next(o for o in each.all_objects if o.name.startswith("mug anchor")) for each in (loaded, other)]
    for anchor in anchors:
        motions.curves(anchor)["location", 0].keyframe_points[0].co.y += 1
        anchor.r5dgs_motion.velocity = (4.0, 5.0, 6.0)
    for damaged in (scene_path, other_path):
        whole = damaged.read_bytes()
        damaged.write_bytes(whole[:-300])
        for order in (anchors, anchors[::-1]):
            motions.choose(blender, *order)
            before = [(fields(anchor), motions.keys(anchor)) for anchor in anchors]
            with pytest.raises(RuntimeError, match=f"(?s){damaged.name}.*bake or copy it again"):
                blender.ops.r5dgs.reset_motion(observed=True)
            assert [(fields(anchor), motions.keys(anchor)) for anchor in anchors] == before
        damaged.write_bytes(whole)
    assert blender.ops.r5dgs.reset_motion(observed=True) == {"FINISHED"}


@pytest.mark.parametrize("t_end", [15.8, 1e30, math.inf])
def test_an_end_that_extrapolation_refuses_is_refused_by_loading_too(blender, scene_path, t_end):
    before = {kind: len(getattr(blender.data, kind)) for kind in KINDS}
    with pytest.raises(RuntimeError, match="synthetic.r5dgs: expected an end of at most 15.75"):
        blender.ops.r5dgs.load_scene(filepath=str(scene_path), t_end=t_end)
    assert {kind: len(getattr(blender.data, kind)) for kind in KINDS} == before
    collection = motions.load(blender, scene_path, t_end=4.0)
    with pytest.raises(RuntimeError, match="expected an end of at most 15.75"):
        blender.ops.r5dgs.extrapolate_until(t_end=t_end)
    assert collection.r5dgs.t_end == 4.0


def test_the_end_that_loading_chooses_is_never_too_far(blender, tmp_path):
    timeline = motions.addon("scene.timeline")
    whole = scenes.make_scene(n=300, objects=3, seed=1)
    for shift, shrink in ((0.0, 0.01), (0.0, 1.0), (50.0, 0.01), (-30.0, 1.0)):
        times = shift + shrink * whole.tracks.times
        scene = dataclasses.replace(whole.with_arrays(track_times=times), t_max=float(times[-1]))
        timeline.check_end("scene", timeline.Times.of(scene))

"""Bounces in Blender: keys at the impacts that keep the jumps of the velocity."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import models
from r5dgs_core.motion.history import Event, History
from r5dgs_core.scene import scene_file
from tests.support import motions, problems, scenes

BOUNCE = models.MotionModel(
    "bounce",
    velocity=[0.4, 0.2, 0.5],
    acceleration=[0, 0, -12],
    angular_velocity=[1, 2, 0.5],
    bounce_time=0.0837,
    restitution=0.6,
    offset_rotvec=[0.02, 0, 0.01],
    offset_displacement=[0.003, 0.002, 0.001],
    radius=0.3,
)


@pytest.fixture
def scene_path(tmp_path, request):
    """A scene whose first body, which a shadow follows, bounces, or moves as the parameter says."""
    made = scenes.make_scene(n=300, objects=3, seed=1)
    model = getattr(request, "param", BOUNCE)
    groups = (made.groups[0], dataclasses.replace(made.groups[1], model=model), *made.groups[2:])
    return scene_file.write(dataclasses.replace(made, groups=groups), tmp_path / "scene.r5dgs")


def around(model):
    """Scene times about the impacts, at frames and between them, until t = 1.2."""
    impacts = scenes.T_MAX + models.kinks(model, 0.45)
    beside = impacts[:6, None] + np.array([-0.3, -0.02, 0.0, 0.02, 0.4]) / 60
    return sorted({*np.linspace(scenes.T_MAX, 1.2, 28), *beside.ravel().tolist()})


def vertical_keys(anchor):
    return list(motions.curves(anchor)["location", 2].keyframe_points)


def test_a_bounce_plays_like_the_core_about_its_impacts(blender, scene_path):
    scene = scene_file.read(scene_path)
    loaded = motions.load(blender, scene_path, t_end=1.2)
    motions.assert_plays_like_the_core(blender, loaded, scene, around(BOUNCE))
    mug = blender.data.objects["mug anchor"]
    frames = 1 + 60 * (scenes.T_MAX + models.kinks(BOUNCE, 0.45)[:3])
    for frame, speed in zip(frames, BOUNCE.restitution ** np.arange(3), strict=True):
        key = min(vertical_keys(mug), key=lambda key: abs(key.co[0] - frame))
        assert abs(key.co[0] - frame) < 1e-4
        assert key.handle_left_type == key.handle_right_type == "FREE" and key.interpolation == "BEZIER"
        falls = (key.co[1] - key.handle_left[1]) / (key.co[0] - key.handle_left[0])
        rises = (key.handle_right[1] - key.co[1]) / (key.handle_right[0] - key.co[0])
        assert rises > 0.5 * speed * 0.3 / 60 and falls < -speed * 0.3 / 60
    assert not mug.r5dgs_motion.too_fast


@pytest.mark.parametrize("scene_path", [problems.TOSSED], indirect=True)
def test_a_trajectory_has_keys_at_its_knots_with_handles_of_both_sides(blender, scene_path):
    scene = scene_file.read(scene_path)
    loaded = motions.load(blender, scene_path, t_end=1.5)
    motions.assert_plays_like_the_core(blender, loaded, scene, np.linspace(scenes.T_MAX, 1.5, 28))
    mug = blender.data.objects["mug anchor"]
    (key,) = (key for key in vertical_keys(mug) if 0.5 < key.co[0] - 1 - 60 * scenes.T_MAX < 0.75 * 60 - 0.5)
    assert key.co[0] == pytest.approx(1 + 60 * (scenes.T_MAX + problems.TOSSED.knots[1, 0]), abs=1e-3)
    falls = (key.co[1] - key.handle_left[1]) / (key.co[0] - key.handle_left[0])
    rises = (key.handle_right[1] - key.co[1]) / (key.handle_right[0] - key.co[0])
    assert (60 * falls, 60 * rises) == pytest.approx((-2.5, 0.9), rel=1e-3)
    motions.choose(blender, blender.data.objects["red apple anchor"])
    blender.context.object.r5dgs_motion.kind = "trajectory"
    with pytest.raises(RuntimeError, match="red apple anchor: knots: expected those of a trajectory"):
        blender.ops.r5dgs.re_extrapolate()


def test_the_tube_of_a_bounce_touches_the_floor_at_its_impacts(blender, scene_path):
    motions.load(blender, scene_path, t_end=1.2)
    mug, tubes = blender.data.objects["mug anchor"], motions.addon("motion.confidence_tubes")
    centers, _ = tubes.path(mug, motions.addon("motion.extrapolate").times_of(mug))
    start, _ = tubes.path(mug, dataclasses.replace(motions.addon("motion.extrapolate").times_of(mug), t_end=0.76))
    for impact in models.kinks(BOUNCE, 0.45)[:4]:
        _, displacement = models.evaluate(BOUNCE, impact)
        assert np.linalg.norm(centers - (start[0] + displacement), axis=-1).min() < 1e-5


def test_an_edited_bounce_keeps_its_impacts_and_its_shadow_follows(blender, scene_path):
    scene = scene_file.read(scene_path)
    loaded = motions.load(blender, scene_path, t_end=1.2)
    mug = blender.data.objects["mug anchor"]
    motions.choose(blender, mug)
    mug.r5dgs_motion.restitution = 0.9
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    model = motions.addon("motion.physics").model(mug)
    assert model.restitution == pytest.approx(0.9)
    edited = dataclasses.replace(scene.groups[1], model=model)
    scene = dataclasses.replace(scene, groups=(scene.groups[0], edited, *scene.groups[2:]))
    motions.assert_plays_like_the_core(blender, loaded, scene, around(model))


def test_a_body_that_friction_stops_rests_from_that_time_on(blender, scene_path):
    scene = scene_file.read(scene_path)
    loaded = motions.load(blender, scene_path, t_end=1.2)
    mug = blender.data.objects["mug anchor"]
    motions.choose(blender, mug)
    state = mug.r5dgs_motion
    state.kind = "friction"
    state.velocity, state.angular_velocity = (0.6, 0.2, 0.0), (0.0, 0.0, 0.0)
    state.stop_time = 0.4 / motions.addon("motion.motion_fields").units_per_second(state)
    assert blender.ops.r5dgs.re_extrapolate() == {"FINISHED"}
    model = motions.addon("motion.physics").model(mug)
    edited = dataclasses.replace(scene.groups[1], model=model)
    scene = dataclasses.replace(scene, groups=(scene.groups[0], edited, *scene.groups[2:]))
    motions.assert_plays_like_the_core(blender, loaded, scene, np.linspace(scenes.T_MAX, 1.2, 40))
    assert vertical_keys(mug)[-1].co[0] < 1 + 60 * (scenes.T_MAX + 0.41)


@pytest.mark.parametrize("share", [0.6, 1.0], ids=["between", "knot"])
def test_an_observed_impact_plays_like_the_core_and_has_a_key(blender, tmp_path, share):
    made = scenes.make_scene(n=300, objects=2, seed=1)
    times, poses = made.tracks.times, made.tracks.poses.copy()
    hit = float(times[5] + share * (times[6] - times[5]))
    poses[1, :, 4:] = (np.abs(times - hit) - np.abs(times[-1] - hit))[:, None] * [1.0, 0.2, -2.0]
    struck = dataclasses.replace(made.groups[1], history=History((Event(hit, "impact", 0.001),)))
    scene = dataclasses.replace(made.with_arrays(track_poses=poses), groups=(made.groups[0], struck, *made.groups[2:]))
    loaded = motions.load(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"), t_end=1.0)
    beside = hit + np.array([-0.4, -0.02, 0.0, 0.02, 0.4]) / 60
    motions.assert_plays_like_the_core(blender, loaded, scene, sorted({*np.linspace(0, 0.74, 23), *beside}))
    key = min(vertical_keys(blender.data.objects["mug anchor"]), key=lambda key: abs(key.co[0] - (1 + 60 * hit)))
    assert abs(key.co[0] - (1 + 60 * hit)) < 1e-4
    arrives = (key.co[1] - key.handle_left[1]) / (key.co[0] - key.handle_left[0])
    leaves = (key.handle_right[1] - key.co[1]) / (key.handle_right[0] - key.co[0])
    assert arrives == pytest.approx(2 / 60, rel=1e-3) and leaves == pytest.approx(-2 / 60, rel=1e-3)

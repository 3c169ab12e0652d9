"""Playback between observed times has the velocity jumps of observed events, and so have keys of exports."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.formats import glb, glb_reader, registry
from r5dgs_core.motion import cubic_curves, rotations
from r5dgs_core.motion.history import Event, History
from r5dgs_core.playback import group_curves, observed_motion
from r5dgs_core.playback.scene_player import Player
from tests.support import arms, scenes

HIT = 0.6 * scenes.T_MAX


def struck(scene, kind="impact", group=1):
    """The scene, in which a body reverses its way at `HIT`, which is an event of its history."""
    times = scene.tracks.times
    poses = scene.tracks.poses.copy()
    poses[group, :, :4] = [1, 0, 0, 0]
    poses[group, :, 4:] = path(times, times[-1])
    groups = list(scene.groups)
    groups[group] = dataclasses.replace(groups[group], history=History((Event(HIT, kind, 0.001),)))
    return dataclasses.replace(scene.with_arrays(track_poses=poses), groups=tuple(groups))


def path(t, end):
    """Displacement from the place at the end. [..., 3]"""
    way = np.array([1.0, 0.2, -2.0])
    return (np.abs(np.asarray(t) - HIT) - (end - HIT))[..., None] * way


@pytest.fixture(scope="module")
def scene():
    return struck(scenes.make_scene(n=200, objects=2))


def test_a_body_turns_back_at_the_impact(scene):
    shown, end = Player(scene), scene.tracks.times[-1]
    assert np.abs(scene.tracks.times - HIT).min() > 0.01
    for t in [*np.linspace(0, end, 40, endpoint=False), HIT - 1e-6, HIT, HIT + 1e-6]:
        _, moves = shown.group_poses(t)
        np.testing.assert_allclose(moves[1], path(t, end), atol=1e-6)


def test_keys_are_the_playback(scene):
    keys, shown = group_curves.observed(scene, 1), Player(scene)
    assert HIT in keys.location.times and HIT not in keys.rotation.times
    for t in np.linspace(0, scene.t_max, 57, endpoint=False):
        np.testing.assert_allclose(
            cubic_curves.evaluate(keys.location, np.array(t)), shown.group_poses(t)[1][1], atol=1e-12
        )


def test_rotations_at_jumps_have_unit_length(scene):
    times, angles = scene.tracks.times, np.abs(scene.tracks.times - HIT) * 12.0
    quats = rotations.rotvecs_to_quats(angles[:, None] * [0.0, 0, 1])
    found = observed_motion.curves(scene, scene.groups[1], quats, scene.tracks.poses[1, :, 4:]).rotation
    assert len(found.times) == len(times) + 1
    np.testing.assert_allclose(np.linalg.norm(found.values, axis=1), 1, atol=1e-12)
    turned = cubic_curves.evaluate(found, np.array([HIT - 1e-7, HIT + 1e-7]), unit=True)
    np.testing.assert_allclose(turned[0], turned[1], atol=1e-5)


def test_a_change_of_the_law_stays_smooth():
    made = struck(scenes.make_scene(n=200, objects=2), "change")
    assert HIT not in group_curves.observed(made, 1).location.times


def test_a_shadow_turns_back_with_its_caster(scene):
    shadow = next(group for group in scene.groups if group.follows is not None)
    poses = scene.tracks.poses.copy()
    poses[shadow.id, :, 4:] = poses[shadow.follows, :, 4:] * [1, 1, 0]
    together = scene.with_arrays(track_poses=poses)
    assert shadow.follows == 1 and HIT in group_curves.observed(together, shadow.id).location.times


def test_parts_stay_smooth():
    made = arms.make_arm("hinge")
    part = next(group for group in made.groups if group.joint is not None)
    groups = list(made.groups)
    groups[part.id] = dataclasses.replace(part, history=History((Event(HIT, "impact", 0.001),)))
    hit = dataclasses.replace(made, groups=tuple(groups))
    np.testing.assert_array_equal(Player(hit).group_poses(0.3)[1], Player(made).group_poses(0.3)[1])


def test_an_exported_file_has_the_jump_and_is_read_back(scene, tmp_path):
    (file,) = glb.export(scene, tmp_path / "scene.glb", registry.Options((0.0,)))
    again = Player(glb_reader.read(file))
    for t in (HIT - 0.01, HIT, HIT + 0.01):
        np.testing.assert_allclose(again.group_poses(t)[1][1], path(t, scene.tracks.times[-1]), atol=1e-5)

"""Objects that are absent at some times are not drawn then, in playback, pictures, exports and predictions."""

import dataclasses
import math

import numpy as np
import pytest

from r5dgs_core.contact import scene_bodies
from r5dgs_core.playback import played_splats, scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import presence
from r5dgs_core.scene.hull import Hull
from tests.support.scenes import make_scene, orbit_camera, with_absence

ABSENT = ((-math.inf, 0.1), (0.3, 0.5))
THERE = {-1.0: False, 0.0: False, 0.09: False, 0.1: True, 0.3: False, 0.4: False, 0.55: True, 2.0: True}


@pytest.mark.parametrize("t, there", THERE.items())
def test_a_frame_hides_an_absent_object_and_its_shadow(t, there):
    whole = make_scene(200)
    scene = with_absence(whole, *ABSENT)
    frame, usual = (scene_player.Player(one).frame(t) for one in (scene, whole))
    gone = np.isin(frame.motion_ids, [] if there else [1, 4])
    assert gone.any() != there
    assert (frame.opacity_logits[gone] == presence.HIDDEN).all()
    np.testing.assert_array_equal(frame.opacity_logits[~gone], usual.opacity_logits[~gone])
    np.testing.assert_array_equal(frame.means, usual.means)


def test_absence_costs_nothing_in_scenes_without_it():
    scene = make_scene(50)
    assert scene_player.Player(scene).frame(0.0).opacity_logits is scene.gaussians.opacity_logits


@pytest.mark.parametrize("t, there", [(0.0, False), (0.2, True)])
def test_pictures_ids_and_exported_gaussians_lack_an_absent_object(t, there):
    scene = with_absence(make_scene(300), *ABSENT)
    splats = played_splats.at(scene_player.Player(scene), t)
    shadow = int((scene.gaussians.motion_ids == 4).sum())
    assert (1 in splats.object_ids) == there
    assert len(splats.means) == 300 - (0 if there else scene.object(1).count + shadow)
    found = scene_renderer.render(scene_player.Player(scene), orbit_camera(0.3), t)
    assert (1 in found.ids) == there


def test_frames_at_given_poses_have_the_objects_of_their_time():
    scene = with_absence(make_scene(50), *ABSENT)
    player = scene_player.Player(scene)
    poses = player.group_poses(0.0)
    assert (player.frame_at_poses(*poses, 0.0).opacity_logits == presence.HIDDEN).any()
    assert not (player.frame_at_poses(*poses).opacity_logits == presence.HIDDEN).any()


def test_what_has_left_touches_nothing():
    scene = make_scene(200, shadows=False)
    rows = [scene.gaussians.motion_ids == g for g in (1, 2)]
    hulls = tuple(Hull(k, k, scene.gaussians.means[mine].astype(float)) for k, mine in enumerate(rows, 1))
    names, told = [], []
    for absent in ((-math.inf, 0.1), (0.7, math.inf)):
        bodies, lines = scene_bodies.of(dataclasses.replace(with_absence(scene, absent), hulls=hulls))
        names.append([body.name for body in bodies])
        told.append(lines)
    assert names == [["mug", "red apple"], ["red apple"]]
    assert told == [[], ["mug: has left the scene before t_max"]]

"""Bodies of a scene that are simulated, and reasons for leaving out others."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.contact import scene_bodies, scene_future
from r5dgs_core.contact.scene_world import Wishes
from r5dgs_core.motion import history
from tests.support import contact_scenes
from tests.support.contact_scenes import SIZE


def came_to_rest(**changes):
    """Scene of a box that moved in the observed time and rests at t_max."""
    scene = contact_scenes.scene(contact_scenes.resting())
    poses = scene.tracks.poses.copy()
    poses[1, :6, 4] = -0.3
    groups = (scene.groups[0], dataclasses.replace(scene.groups[1], **changes))
    return dataclasses.replace(scene, groups=groups, tracks=dataclasses.replace(scene.tracks, poses=poses))


def test_a_body_that_came_to_rest_does_not_move_unless_another_carries_it():
    (body,), _ = scene_bodies.of(came_to_rest())
    assert not body.moves and not body.reason
    (carried,), _ = scene_bodies.of(came_to_rest(follows=0, follow_matrix=np.eye(3)))
    assert carried.moves and carried.reason == "it is a part of another body"


def test_a_body_that_was_not_seen_since_it_set_off_moves_on_with_the_reason():
    scene = contact_scenes.scene(contact_scenes.falling())
    past = dataclasses.replace(history.EMPTY, events=(history.Event(scene.t_max, "change", 0.0),))
    groups = (scene.groups[0], dataclasses.replace(scene.groups[1], history=past))
    found = scene_future.predict(dataclasses.replace(scene, groups=groups), Wishes(samples=1))
    assert found.lines == ("box 1: keeps its smooth motion: it was not seen since it set off",)
    assert found.penetrations["box 1"] > 1 and not found.taken


@pytest.mark.parametrize(("speed", "count"), [(0.0, 6), (1.0, 13)], ids=["still", "moving"])
def test_a_track_begins_when_the_body_set_off_if_it_was_still_before(speed, count):
    scene = contact_scenes.scene(contact_scenes.sliding(1.0))
    poses = scene.tracks.poses.copy()
    before = scene.tracks.times < 0.32
    poses[1, before, 4] = poses[1, before, 4][-1] + speed * (scene.tracks.times[before] - 0.3)
    past = dataclasses.replace(history.EMPTY, events=(history.Event(0.32, "start", 0.0),))
    groups = (scene.groups[0], dataclasses.replace(scene.groups[1], history=past))
    scene = dataclasses.replace(scene, groups=groups, tracks=dataclasses.replace(scene.tracks, poses=poses))
    assert len(scene_bodies.track(scene, scene_bodies.of(scene)[0][0])) == count


def test_the_places_of_a_track_are_those_of_the_given_centre():
    scene = contact_scenes.scene(contact_scenes.falling())
    (body,), _ = scene_bodies.of(scene)
    lower = body.solid.center - [0, 0, 0.1 * SIZE]
    assert scene_bodies.track(scene, body, lower).places[-1] == pytest.approx(lower)
    assert scene_bodies.track(scene, body).places[-1] == pytest.approx(body.solid.center)

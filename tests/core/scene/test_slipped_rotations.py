"""Scene files hold the rotations that slipped, so that a prediction from a file equals the one of baking."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.contact import scene_bodies
from r5dgs_core.motion.history import UNKNOWN_TURN, History, PoseErrors
from r5dgs_core.scene import scene_file, slipped_rotations
from tests.support import contact_scenes

TIMES = contact_scenes.TIMES
SPANS = {1: [(TIMES[2], TIMES[5]), (TIMES[-2], np.inf)]}
ERRORS = PoseErrors((0.01,) * len(TIMES), (0.02,) * len(TIMES))


@pytest.fixture
def scene():
    made = contact_scenes.scene(contact_scenes.falling(), contact_scenes.resting())
    groups = (made.groups[0], *(dataclasses.replace(one, history=History(errors=ERRORS)) for one in made.groups[1:]))
    return dataclasses.replace(made, groups=groups)


def test_slips_are_stored_with_the_scene_and_mark_its_rotations(scene, tmp_path):
    told = dataclasses.replace(scene, provenance=slipped_rotations.record(SPANS))
    back = scene_file.read(scene_file.write(told, tmp_path / "scene.r5dgs"))
    assert slipped_rotations.recorded(back) == SPANS
    turns = scene_bodies.without_contacts(back).groups[1].history.errors.turn
    assert [n for n, turn in enumerate(turns) if turn == UNKNOWN_TURN] == [3, 4, len(TIMES) - 1]
    assert scene_bodies.track(slipped_rotations.unknown(scene, SPANS), scene_bodies.of(scene)[0][0]).turn_noise[0] < 1


def test_without_slips_nothing_is_recorded_and_the_groups_stay(scene):
    assert slipped_rotations.record({}) == {} and slipped_rotations.recorded(scene) == {}
    assert all(a is b for a, b in zip(scene_bodies.without_contacts(scene).groups, scene.groups, strict=True))


@pytest.mark.parametrize(
    "record", [3, [], {"1": 3}, {"a": []}, {"1": [[1, 2, 3]]}, {"9": [[0, 1]]}, {"1": [[10**400, None]]}]
)
def test_a_foreign_record_is_ignored(scene, record):
    assert slipped_rotations.recorded(dataclasses.replace(scene, provenance={slipped_rotations.RECORD: record})) == {}

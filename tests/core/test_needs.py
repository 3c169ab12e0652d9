"""What a scene carries follows from what was measured, and the table says so."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene.scene import MotionGroup
from r5dgs_core.train import needs

RADIUS = 0.4


def table(travel=0.0, turn=0.0, *, shading=0.0, sky=1, bases=1, shadow=False, bodies=1, classified=True):
    """The decisions for bodies of which the first moves by ``travel`` diameters and turns by ``turn`` radians."""
    poses = [np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1)) for _ in range(bodies + 2)]
    if bodies:
        poses[1][0, :4] = rotations.rotvecs_to_quats(np.array([0, 0, turn]))
        poses[1][0, 4] = travel * 2 * RADIUS
    groups = [MotionGroup(0, 0, "pinned", 0, np.zeros(3), MotionModel())]
    groups += [MotionGroup(k, k, "body", 0, np.zeros(3), MotionModel(radius=RADIUS)) for k in range(1, bodies + 1)]
    if shadow:
        groups.append(MotionGroup(bodies + 1, 1, "shadow", 0, np.zeros(3), MotionModel(), 1, np.eye(3)))
    ids = np.array([0] * 5 + [1] * 5 * (bodies > 0) + [bodies + 1] * 5 * shadow)
    gradients = np.full((len(ids), 3), shading)
    rows = needs.decide(groups, poses, ids, gradients, np.array([0, 0, 1.0]), np.zeros((sky, 3)), bases, classified)
    return {row["name"]: row for row in rows}


def decisions(**given):
    return {name: row["decision"] for name, row in table(**given).items()}


def test_a_scene_at_rest_needs_nothing_that_moves():
    found = decisions()
    assert found["tracks"] == found["rotation"] == found["shading"] == found["shadows"] == "off"
    assert found["view_dependent_colour"] == found["sky_gradient"] == "off" and found["classifier"] == "on"


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"travel": 2 * needs.STILL}, "tracks"),
        ({"turn": 2 * needs.TURN}, "tracks"),
        ({"turn": 2 * needs.TURN}, "rotation"),
        ({"turn": 1.0, "shading": 0.1}, "shading"),
        ({"shadow": True}, "shadows"),
        ({"bases": 4}, "view_dependent_colour"),
        ({"sky": 4}, "sky_gradient"),
    ],
)
def test_each_need_follows_its_own_cause(given, name):
    row = table(**given)[name]
    assert row["decision"] == "on" and row["reason"]
    assert decisions()[name] == "off"


def test_an_object_that_only_slides_needs_no_rotation_and_no_shading():
    found = decisions(travel=1.0, shading=0.5)
    assert (found["tracks"], found["rotation"], found["shading"]) == ("on", "off", "off")


def test_less_than_the_thresholds_counts_as_rest():
    assert decisions(travel=0.5 * needs.STILL, turn=0.5 * needs.TURN)["tracks"] == "off"


def test_the_numbers_are_those_of_the_motion():
    rows = table(travel=1.5, turn=0.7)
    assert rows["tracks"]["value"] == pytest.approx(1.5)
    assert rows["rotation"]["value"] == pytest.approx(0.7)


def test_without_objects_nothing_moves():
    assert decisions(bodies=0)["tracks"] == "off"


def test_a_classifier_is_on_where_one_was_trained():
    assert decisions(classified=False)["classifier"] == "off"


def test_what_is_off_is_not_in_the_scene(baked):
    found = {row["name"]: row["decision"] for row in baked.needs}
    assert (found["shading"] == "on") == (baked.shading is not None)
    assert (found["classifier"] == "on") == (baked.identities is not None)
    assert (found["sky_gradient"] == "on") == (len(baked.background_sh) > 1)


def test_a_group_that_hardly_moves_is_still():
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1))
    assert needs.is_still(poses, RADIUS)
    poses[0, 5] = 3 * needs.STILL * 2 * RADIUS
    assert not needs.is_still(poses, RADIUS)


def test_the_tiny_scene_is_judged_by_what_it_shows(baked):
    found = {row["name"]: row["decision"] for row in baked.needs}
    assert found["tracks"] == found["rotation"] == found["classifier"] == "on"
    assert found["view_dependent_colour"] == "off"

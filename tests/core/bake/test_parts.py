import dataclasses

import numpy as np
import pytest

from r5dgs_core.bake import parts
from r5dgs_core.data.annotations import GroundTruth
from r5dgs_core.evaluation import ground_truth_poses
from r5dgs_core.motion import models, se3
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import motion_words
from tests.support import arms


def loose(kind):
    """An arm whose joint was not found yet."""
    scene = arms.make_arm(kind)
    groups = [dataclasses.replace(g, parent=None, joint=None) for g in scene.groups]
    return dataclasses.replace(scene, groups=tuple(groups))


@pytest.mark.default_cases("hinge", "slider")
@pytest.mark.parametrize("kind", ["hinge", "ball", "slider"])
def test_joints_between_bodies_of_one_object_are_found(kind):
    scene = loose(kind)
    found = parts.connect(scene, np.ones((len(scene.groups), len(scene.tracks.times)), bool))
    jointed = [g for g in found.groups if g.joint is not None]
    assert len(jointed) == 1 and jointed[0].joint.kind == kind
    assert {jointed[0].id, jointed[0].parent} == {1, 2}
    words = motion_words.motion_of(found, [found.groups[1], found.groups[2]])
    assert f": {kind}" in words and "part" in words


def test_bodies_of_different_objects_stay_apart():
    scene = arms.make_arm()
    groups = [dataclasses.replace(g, parent=None, joint=None, object_id=g.id) for g in scene.groups[:3]]
    split = dataclasses.replace(scene, groups=(*groups, *scene.groups[3:]))
    table = tuple(dataclasses.replace(item) for item in scene.objects)
    found = parts.connect(dataclasses.replace(split, objects=table), np.ones((len(scene.groups), 13), bool))
    assert all(g.joint is None for g in found.groups)


def test_true_bodies_of_one_object_are_compared_with_the_parts_that_move_alike():
    scene = arms.make_arm()
    times = np.array([0.0, 0.2, 0.5, 0.75, 1.0])
    poses = [scene_player.Player(scene).group_poses(float(t)) for t in times]
    truth = np.stack(
        [np.stack([se3.pose_to_matrix(scene.groups[g].pivot, q[g], d[g]) for q, d in poses]) for g in (2, 1)]
    )
    known = GroundTruth(times, (1, 1), ("lower", "upper"), truth, 0.75)
    for every in (False, True):
        found = ground_truth_poses.bodies(scene, known, every=every)
        assert {(body.name, body.group.id) for body in found} == {("lower", 2), ("upper", 1)}
        assert max(body.turn_error_deg for body in found) < 1e-4
    single = dataclasses.replace(known, object_ids=(1,), names=("lower",), matrices=truth[:1])
    assert len(ground_truth_poses.bodies(scene, single)) == 1
    turned = dataclasses.replace(known, names=("upper", "lower"))  # of the groups 2 and 1
    assert [body.name for body in ground_truth_poses.bodies(scene, turned)] == ["upper", "lower"]


def test_a_root_at_rest_carries_the_part():
    scene = loose("hinge")
    poses = scene.tracks.poses.copy()
    poses[1] = [1.0, 0, 0, 0, 0, 0, 0]
    groups = list(scene.groups)
    groups[1] = dataclasses.replace(groups[1], model=models.MotionModel(radius=0.3))
    still = dataclasses.replace(scene.with_arrays(track_poses=poses), groups=tuple(groups))
    assert parts._doubt(still, still.groups[1]) < parts._doubt(still, still.groups[2])

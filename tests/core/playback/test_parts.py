import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import joint as joints
from r5dgs_core.motion import models
from r5dgs_core.playback import group_dynamics, scene_player
from tests.support import arms

BETWEEN = (-0.1, 0.0, 0.13, 0.31, 0.44, 0.58, 0.7499)
LATER = (0.75, 0.8, 1.0, 1.9)


def gap(scene, t):
    """Distance between both parts' images of the joint's point."""
    quats, moves = scene_player.Player(scene).group_poses(t)
    point, ends = scene.groups[2].joint.point, []
    for row in (1, 2):
        pivot = scene.groups[row].pivot
        ends.append(
            joints.composed((quats[row], moves[row]), pivot, (np.array([1.0, 0, 0, 0]), np.zeros(3)), pivot, point)[1]
        )
    return np.linalg.norm(ends[0] - ends[1])


@pytest.mark.parametrize("kind", ["hinge", "ball"])
def test_joints_stay_closed_at_all_times(kind):
    scene = arms.make_arm(kind)
    assert max(gap(scene, t) for t in (*BETWEEN, *LATER)) < 1e-12


def test_parts_keep_their_knots_and_their_bind_state():
    scene = arms.make_arm()
    for s, t in enumerate(scene.tracks.times):
        quats, moves = scene_player.Player(scene).group_poses(float(t))
        np.testing.assert_allclose(moves, scene.tracks.poses[:, s, 4:], atol=1e-12)
        np.testing.assert_allclose(np.abs((quats * scene.tracks.poses[:, s, :4]).sum(-1)), 1, atol=1e-12)
    still = scene_player.Player(scene).frame(scene.t_max)
    np.testing.assert_array_equal(still.means, scene.gaussians.means)


def test_a_part_moves_with_its_parent_past_t_max():
    scene = arms.make_arm()
    quats, moves = scene_player.Player(scene).group_poses(1.1)
    part, tau = scene.groups[2], 1.1 - scene.t_max
    parent = models.evaluate(scene.groups[1].model, tau)
    expected = joints.composed(parent, scene.groups[1].pivot, part.joint.poses(tau), part.joint.point, part.pivot)
    np.testing.assert_allclose(quats[2], expected[0], atol=1e-12)
    np.testing.assert_allclose(moves[2], expected[1], atol=1e-12)


def test_a_part_stops_at_its_limit():
    scene = arms.make_arm()
    groups = list(scene.groups)
    groups[2] = dataclasses.replace(groups[2], joint=dataclasses.replace(groups[2].joint, stop_time=0.1))
    scene = dataclasses.replace(scene, groups=tuple(groups))

    def turn(t):
        quats, moves = scene_player.Player(scene).group_poses(t)
        pivots = [g.pivot for g in scene.groups]
        return joints.relative((quats[1], moves[1]), pivots[1], (quats[2], moves[2]), pivots[2], arms.POINT)[0]

    np.testing.assert_allclose(turn(0.85), turn(1.5), atol=1e-12)
    assert np.abs(turn(0.85) - turn(0.8)).max() > 0.01


def test_a_chain_of_parts_is_carried_from_its_root():
    scene = arms.make_arm()
    groups = list(scene.groups)
    groups[3] = dataclasses.replace(groups[3], object_id=1, parent=2, joint=groups[2].joint)
    groups[1], groups[2] = groups[2], groups[1]
    groups[1] = dataclasses.replace(groups[1], id=1, parent=2)
    groups[2] = dataclasses.replace(groups[2], id=2)
    groups[3] = dataclasses.replace(groups[3], parent=1)
    order = [g.id for g, _ in group_dynamics.parts_of(groups)]
    assert order == [1, 3]

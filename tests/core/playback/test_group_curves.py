import numpy as np
import pytest

from r5dgs_core.motion import cubic_curves
from r5dgs_core.playback import group_curves, scene_player
from tests.support import scenes


@pytest.mark.parametrize("end", [scenes.T_MAX, 1.4])
def test_curves_follow_playback_within_the_tolerance(end):
    scene = scenes.make_scene(n=300, objects=5, seed=1)
    player, reaches = scene_player.Player(scene), group_curves.reaches(scene)
    times = np.linspace(0, end, 97)
    poses = [player.group_poses(float(t)) for t in times]
    for group in scene.groups:
        found = group_curves.curves(scene, group.id, end, float(reaches[group.id]))
        moves = cubic_curves.evaluate(found.location, times)
        quats = cubic_curves.evaluate(found.rotation, times, unit=True)
        away = np.linalg.norm(moves - [move[group.id] for _, move in poses], axis=-1).max()
        cosines = np.abs((quats * [quat[group.id] for quat, _ in poses]).sum(-1)).clip(max=1)
        turned = 2 * reaches[group.id] * np.sqrt(1 - cosines**2).max()
        assert away + turned < 2 * group_curves.TOLERANCE * scene.extent


def test_the_reach_is_the_largest_distance_of_a_member():
    scene = scenes.make_scene(n=200, objects=2)
    rows = scene.gaussians.motion_ids == 2
    wanted = np.linalg.norm(scene.gaussians.means[rows] - scene.groups[2].pivot, axis=-1).max()
    assert group_curves.reaches(scene)[2] == pytest.approx(wanted)

"""Motions that a report fits to observed poses are those of the scene file."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.bake import pose_errors, simplify_motion
from r5dgs_core.bake.unseen_rotations import Unseen
from r5dgs_core.error_vs_time import pose_task
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.history import PoseErrors
from tests.support import tiny_datasets

PLACE, TURN = 0.003, 0.02  # errors of the poses, world units and rad
ASIDE = np.array([0.1, 0.05, 0.0])  # pivots from the centres of the bodies


def simplified(unseen):
    """The tiny scene with noise of its poses, and its motion past t_max as in baking."""
    scene, draw = tiny_datasets.make_truth(), np.random.default_rng(4)
    poses, groups = scene.tracks.poses.copy(), list(scene.groups)
    shape = (len(scene.tracks.times) - 1, 3)  # the last pose is that of the Gaussians
    bodies = [group.id for group in groups if group.role == "body"]
    for body in bodies:
        turns = rotations.rotvecs_to_quats(TURN * draw.normal(size=shape))
        poses[body, :-1, :4] = rotations.multiply(turns, poses[body, :-1, :4])
        poses[body, :-1, 4:] += PLACE * draw.normal(size=shape)
        poses[body, :, 4:] += rotations.rotate(poses[body, :, :4], np.tile(ASIDE, (len(poses[body]), 1))) - ASIDE
        groups[body] = dataclasses.replace(groups[body], pivot=groups[body].pivot + ASIDE)
    errors = PoseErrors((PLACE, np.inf) + (PLACE,) * (shape[0] - 1), (TURN, np.inf) + (TURN,) * (shape[0] - 1))
    noisy = dataclasses.replace(scene.with_arrays(track_poses=poses), groups=tuple(groups))
    observed = np.ones((len(groups), len(scene.tracks.times)), bool)
    measured = pose_errors.Measured(dict.fromkeys(bodies, errors), unseen)
    return simplify_motion.simplify(noisy, observed, None, measured=measured).scene


@pytest.mark.parametrize("axes", [None, np.eye(3)], ids=["seen", "unseen"])
def test_the_fit_is_the_motion_of_the_scene_file_also_if_no_image_shows_the_rotation(axes):
    scene = simplified({} if axes is None else {tiny_datasets.BRICK: Unseen(axes, 0.1)})
    bodies = [group for group in scene.groups if group.role == "body"]
    assert [bool(group.model.angular_velocity.any()) for group in bodies] == [axes is None, False]
    tau = np.linspace(0, 0.25, 4)
    for group in bodies:
        fitted = pose_task.fit_group(scene, group, None)
        moved = zip(models.evaluate(fitted.model, tau), models.evaluate(group.model, tau), strict=True)
        for ours, stored in moved:
            np.testing.assert_allclose(ours, stored, atol=1e-9)
        if axes is None:
            bands = [history.band.widths(1.0 + tau) for history in (fitted.history, group.history)]
            np.testing.assert_allclose(*bands, rtol=1e-6)

"""Evidence for parts: joints between the tracks of a run."""

import numpy as np
import pytest
import torch

from r5dgs_core.motion import rotations
from r5dgs_core.train import part_trial
from tests.support import arms, tiny_datasets

PARTS = (tiny_datasets.BRICK, tiny_datasets.BALL)


def move_as_arm(trainer, kind):
    """Let both bodies move as the links of an arm, in any frame."""
    tracks, means = trainer.motion.tracks, trainer.gaussians.params["means"]
    links = arms.links(kind, trainer.times, np.random.default_rng(0))
    frame = rotations.rotvecs_to_quats(np.array([0.4, -0.3, 0.8]))
    with torch.no_grad():
        for part, link in zip(PARTS, links, strict=False):
            mine = trainer.gaussians.motion_ids == part
            spread = means[mine] - means[mine].mean(0)
            center = link.pivot + [0.1, 0.2, 0.3]
            means[mine] = torch.from_numpy(center).float() + spread * (link.radius / spread.norm(dim=1).quantile(0.9))
            tracks.centers[part] = torch.from_numpy(center)
            tracks.base_quats[part] = torch.from_numpy(rotations.multiply(link.quats, frame)).float()
            tracks.params["rotvecs"][part] = 0.0
            tracks.params["translations"][part] = torch.from_numpy(link.pivot - center + link.displacements).float()


@pytest.mark.parametrize(("kind", "expected"), [("hinge", True), ("free", False)])
def test_parts_are_joined_if_a_joint_explains_their_tracks(trainer, kind, expected):
    move_as_arm(trainer, kind)
    assert part_trial.are_joined(trainer, PARTS) is expected


def test_parts_without_members_are_not_joined(trainer):
    move_as_arm(trainer, "hinge")
    trainer.gaussians.motion_ids[trainer.gaussians.motion_ids == PARTS[1]] = PARTS[0]
    assert not part_trial.are_joined(trainer, PARTS)

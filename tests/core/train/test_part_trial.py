"""Evidence for parts: joints between the tracks of a run."""

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.train import checkpoint, part_trial
from r5dgs_core.train.trainer import Trainer
from tests.support import arms, tiny_datasets

PARTS = (tiny_datasets.BRICK, tiny_datasets.BALL)


def trainer_of(tiny, trained, kind):
    """Trainer whose two bodies move as the links of an arm, in any frame."""
    made = Trainer(datasets.read(tiny.root), trained.config)
    made.restore(checkpoint.load(trained.folder))
    tracks, means = made.motion.tracks, made.gaussians.params["means"]
    links = arms.links(kind, made.times, np.random.default_rng(0))
    frame = rotations.rotvecs_to_quats(np.array([0.4, -0.3, 0.8]))
    with torch.no_grad():
        for part, link in zip(PARTS, links, strict=False):
            mine = made.gaussians.motion_ids == part
            spread = means[mine] - means[mine].mean(0)
            center = link.pivot + [0.1, 0.2, 0.3]
            means[mine] = torch.from_numpy(center).float() + spread * (link.radius / spread.norm(dim=1).quantile(0.9))
            tracks.centers[part] = torch.from_numpy(center)
            tracks.base_quats[part] = torch.from_numpy(rotations.multiply(link.quats, frame)).float()
            tracks.params["rotvecs"][part] = 0.0
            tracks.params["translations"][part] = torch.from_numpy(link.pivot - center + link.displacements).float()
    return made


@pytest.mark.parametrize(("kind", "expected"), [("hinge", True), ("free", False)])
def test_parts_are_joined_if_a_joint_explains_their_tracks(tiny, trained, kind, expected):
    assert part_trial.are_joined(trainer_of(tiny, trained, kind), PARTS) is expected


def test_parts_without_members_are_not_joined(tiny, trained):
    trainer = trainer_of(tiny, trained, "hinge")
    trainer.gaussians.motion_ids[trainer.gaussians.motion_ids == PARTS[1]] = PARTS[0]
    assert not part_trial.are_joined(trainer, PARTS)

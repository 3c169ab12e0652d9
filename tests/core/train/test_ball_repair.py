"""Repair of the rotations of balls in a trained run: drift is undone, and everything else keeps its bits."""

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.train import ball_repair, checkpoint
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

BRICK, BALL = tiny_datasets.BRICK, tiny_datasets.BALL


@pytest.fixture
def trainer(tiny, trained):
    made = Trainer(datasets.read(tiny.root), trained.config)
    made.restore(checkpoint.load(trained.folder))
    return made


def quats(trainer):
    return rotations.normalize(trainer.motion.tracks.knot_quats().detach().numpy()[BALL].astype(np.float64))


def drift(trainer, rate):
    """Let the track of the ball drift by an angle per time, degrees."""
    count = len(trainer.times)
    turns = rotations.rotvecs_to_quats(np.radians(rate) * np.arange(count)[:, None] * np.array([0.6, 0.8, 0]))
    new = rotations.multiply(turns, quats(trainer))
    trainer.motion.tracks.base_quats[BALL] = torch.from_numpy(new).float()
    with torch.no_grad():
        trainer.motion.tracks.params["rotvecs"][BALL] = 0.0


def worst(trainer, before):
    """Largest change of a rotation but for a constant turn of the ball, degrees."""
    off = rotations.multiply(rotations.conjugate(before), quats(trainer))
    return np.degrees(rotations.angle_between(off, off[len(off) // 2])).max()


@pytest.mark.default_cases("9.0")
@pytest.mark.parametrize("rate", [3.0, 9.0])
def test_drift_of_a_ball_is_undone(trainer, rate):
    before = quats(trainer)
    drift(trainer, rate)
    start = worst(trainer, before)
    assert ball_repair.repair(trainer) == 1
    assert worst(trainer, before) < min(6, 0.5 * start)


def test_a_repair_changes_the_ball_alone(trainer):
    before = trainer.state().tensors
    drift(trainer, 9.0)
    ball_repair.repair(trainer)
    after = trainer.state().tensors
    others = trainer.gaussians.motion_ids != BALL
    for name, tensor in before.items():
        if name.startswith("gaussians."):
            assert torch.equal(after[name][others], tensor[others])
        elif name in ("tracks.base_quats", "tracks.rotvecs", "tracks.translations"):
            assert torch.equal(after[name][BRICK], tensor[BRICK])
        elif not name.startswith("adam."):
            assert torch.equal(after[name], tensor)


def test_a_sound_track_keeps_its_bits(trainer):
    ball_repair.repair(trainer)
    before = trainer.state().tensors
    assert ball_repair.repair(trainer) == 0
    after = trainer.state().tensors
    assert all(torch.equal(after[name], before[name]) for name in before)

"""Repair of the rotations of balls in a trained run: drift is undone, and everything else keeps its bits."""

import numpy as np
import pytest
import torch

from r5dgs_core.model import residual_field
from r5dgs_core.motion import rotations
from r5dgs_core.train import ball_repair, part_trial, residual_trial
from r5dgs_core.train.ball_outlines import Ball
from tests.support import tiny_datasets

BRICK, BALL = tiny_datasets.BRICK, tiny_datasets.BALL


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
    drift(trainer, 9.0)
    before = {name: tensor.clone() for name, tensor in trainer.state().tensors.items()}
    assert ball_repair.repair(trainer) == 1
    after = trainer.state().tensors
    others = trainer.gaussians.motion_ids != BALL
    assert not torch.equal(after["tracks.base_quats"][BALL], before["tracks.base_quats"][BALL])
    for name, tensor in before.items():
        if tensor.ndim and len(tensor) == len(others):
            assert torch.equal(after[name][others], tensor[others]), name
        elif any(part in name for part in ("base_quats", "rotvecs", "translations")) and tensor.ndim:
            assert torch.equal(after[name][BRICK], tensor[BRICK]), name
        else:
            assert torch.equal(after[name], tensor), name


def turn(trainer, knot, degrees):
    """Turn the ball at one time."""
    spin = rotations.rotvecs_to_quats(np.radians(degrees) * np.array([0.6, 0.8, 0]))
    new = quats(trainer)
    new[knot] = rotations.multiply(spin, new[knot])
    trainer.motion.tracks.base_quats[BALL] = torch.from_numpy(new).float()
    with torch.no_grad():
        trainer.motion.tracks.params["rotvecs"][BALL] = 0.0


@pytest.mark.parametrize(("harm", "placed"), [((turn, 2, 25.0), False), ((drift, 9.0), True)])
def test_gaussians_are_placed_anew_if_most_rotations_were_wrong(trainer, harm, placed):
    harm[0](trainer, *harm[1:])
    rows = trainer.gaussians.motion_ids == BALL
    before = trainer.gaussians.means.detach()[rows].clone()
    assert ball_repair.repair(trainer) == 1
    assert torch.equal(trainer.gaussians.means.detach()[rows], before) != placed


def test_a_ball_keeps_its_path_at_times_without_outlines(trainer):
    tracks = trainer.motion.tracks
    centers = np.zeros((len(trainer.times), 3))
    measured = np.arange(len(trainer.times)) != 2
    ball = ball_repair._completed(tracks, BALL, Ball(centers, 1.0, measured))
    moved = (tracks.centers[BALL] + tracks.params["translations"][BALL]).detach().numpy().astype(np.float64)
    offset = ball_repair._offset(tracks, BALL, Ball(centers, 1.0, measured))
    np.testing.assert_array_equal(ball.centers[measured], 0)
    np.testing.assert_allclose(ball.centers[2], moved[2] + rotations.rotate(quats(trainer)[2], offset), atol=1e-6)


def test_a_sound_track_keeps_its_bits(trainer):
    ball_repair.repair(trainer)
    before = trainer.state().tensors
    assert ball_repair.repair(trainer) == 0
    after = trainer.state().tensors
    assert all(torch.equal(after[name], before[name]) for name in before)


@pytest.fixture
def bending(trainer, monkeypatch):
    """The trainer, whose trial of residuals finds a gain for both bodies."""
    tensors = trainer.state().tensors
    weights = torch.sigmoid(tensors["gaussians.opacity_logits"])
    field = residual_field.spread(
        tensors["gaussians.means"], tensors["gaussians.motion_ids"], weights, [BRICK, BALL], 8, len(trainer.times)
    )
    found = residual_trial.Trial(field, np.array([2.0, 2.0]), np.ones((2, 2)), [], [])
    monkeypatch.setattr(residual_trial, "_try", lambda *_: found)
    monkeypatch.setattr(part_trial, "divide", lambda *_: None)
    return trainer


@pytest.mark.parametrize(("settings", "bent"), [((), [BRICK]), (("needs.residuals=on",), [BRICK, BALL])])
def test_a_ball_with_one_turning_texture_does_not_bend(bending, settings, bent):
    bending.config = bending.config.override(["train.repair=true", *settings])
    residual_trial.decide(bending, lambda _: None)
    assert bending.motion.residuals.bodies == bent


def test_a_ball_whose_texture_changes_may_bend(bending, monkeypatch):
    bending.config = bending.config.override(["train.repair=true"])
    monkeypatch.setattr(ball_repair, "TEXTURED", 0.0)
    residual_trial.decide(bending, lambda _: None)
    assert bending.motion.residuals.bodies == [BRICK, BALL]

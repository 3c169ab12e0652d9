"""Repair of slipped poses: slips are found and undone, and everything else keeps its bits."""

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.train import pose_repair, run
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

BRICK, BALL = tiny_datasets.BRICK, tiny_datasets.BALL


def quats(trainer, body):
    return rotations.normalize(trainer.motion.tracks.knot_quats().detach().numpy()[body].astype(np.float64))


def slip(trainer, body, knots, axis, degrees):
    turn = rotations.rotvecs_to_quats(np.radians(degrees) * np.asarray(axis, np.float64))
    for s in knots:
        new = rotations.multiply(turn, quats(trainer, body)[s])
        trainer.motion.tracks.base_quats[body, s] = torch.from_numpy(new).float()
        with torch.no_grad():
            trainer.motion.tracks.params["rotvecs"][body, s] = 0.0


def off(trainer, body, before):
    return np.degrees(rotations.angle_between(quats(trainer, body), before))


@pytest.mark.default_cases("knots1-axis1-35")
@pytest.mark.parametrize(
    "knots, axis, degrees", [((2,), (0, 0, 1), 40), ((4, 5), (0.6, 0.8, 0), 35), ((0,), (1, 0, 0), 45)]
)
def test_slipped_knots_are_repaired(trainer, knots, axis, degrees):
    before = quats(trainer, BRICK)
    slip(trainer, BRICK, knots, axis, degrees)
    assert off(trainer, BRICK, before)[list(knots)] == pytest.approx(degrees, abs=0.1)
    assert pose_repair.repair(trainer) >= len(knots)
    assert off(trainer, BRICK, before).max() < 8


def test_a_repair_leaves_other_bodies_alone(trainer):
    before = trainer.state().tensors
    slip(trainer, BRICK, (3,), (0, 0, 1), 40)
    pose_repair.repair(trainer)
    after = trainer.state().tensors
    for name in ("tracks.base_quats", "tracks.rotvecs", "tracks.translations"):
        assert torch.equal(after[name][BALL], before[name][BALL])
    assert all(torch.equal(after[name], before[name]) for name in before if not name.startswith("tracks."))


@pytest.mark.slow
def test_a_body_that_no_pose_explains_keeps_its_bits_unless_it_is_much_better(trainer, monkeypatch):
    turns = quats(trainer, BRICK)
    slip(trainer, BRICK, (3,), (0, 0, 1), 40)
    before = trainer.state().tensors
    monkeypatch.setattr(pose_repair, "UNUSUAL", 0.01)  # even the true poses have larger errors
    monkeypatch.setattr(pose_repair, "MUCH", 0.0)  # and no error is much smaller
    assert pose_repair.repair(trainer) == 0
    after = trainer.state().tensors
    assert all(torch.equal(after[name], before[name]) for name in before)
    monkeypatch.setattr(pose_repair, "MUCH", 0.7)
    assert pose_repair.repair(trainer) > 0
    assert off(trainer, BRICK, turns).max() < 8


def test_a_sound_track_keeps_its_bits(trainer, monkeypatch):
    monkeypatch.setattr(pose_repair, "JUMP", 1e-9)  # every knot is registered
    monkeypatch.setattr(pose_repair, "CLEARLY", 0.0)  # and found to be right
    before = trainer.state().tensors
    assert pose_repair.repair(trainer) == 0
    after = trainer.state().tensors
    assert all(torch.equal(after[name], before[name]) for name in before)


@pytest.mark.parametrize("end", ["first", "last"])
def test_a_false_spin_is_not_extrapolated(trainer, end):
    last = len(trainer.times) - 1
    s, near = (0, 1) if end == "first" else (last, last - 1)
    slip(trainer, BRICK, (s,), (1, 0, 0), 40)
    ball, shifts = quats(trainer, BALL), trainer.motion.tracks.params["translations"].detach().clone()
    pose_repair.hold_rotations(trainer, s, near)
    found = quats(trainer, BRICK)
    assert found[s] == pytest.approx(found[near], abs=1e-6)
    assert np.array_equal(quats(trainer, BALL), ball)
    assert torch.equal(trainer.motion.tracks.params["translations"], shifts)


def test_a_true_spin_is_extrapolated(trainer, monkeypatch):
    last = len(trainer.times) - 1
    monkeypatch.setattr(pose_repair, "APART", 0.0)  # the rotations of all bodies are compared
    before = trainer.state().tensors
    pose_repair.hold_rotations(trainer, last, last - 1)
    after = trainer.state().tensors
    assert off(trainer, BRICK, quats(trainer, BRICK)[last - 1])[last] > 1
    assert all(torch.equal(after[name], before[name]) for name in before)


def steady(count=10, rate=1.5):
    times = np.linspace(0, 1, count)
    return times, rotations.rotvecs_to_quats(rate * times[:, None] * np.array([0, 0, 1.0]))


def test_a_steady_track_is_not_suspicious():
    times, turns = steady()
    assert len(pose_repair.suspicious(np.ones(10), turns, times)) == 0


def test_jumps_and_unusual_errors_are_suspicious():
    times, turns = steady()
    turns[4] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0.4, 0, 0])), turns[4])
    errors = np.ones(10)
    errors[8] = 1.7
    found = pose_repair.suspicious(errors, turns, times)
    assert found[0] == 4 and set(found) == {3, 4, 5, 8}


def test_a_hidden_knot_is_not_suspicious_and_predicts_nothing():
    times, turns = steady()
    turns[4] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0.4, 0, 0])), turns[4])
    errors = np.ones(10)
    errors[4] = np.nan
    assert len(pose_repair.suspicious(errors, turns, times)) == 0


@pytest.mark.slow
def test_a_fast_body_is_not_lost_as_times_enter(tmp_path, monkeypatch):
    spin = {"velocity": [0.9, 0.35, 0.0], "angular_velocity": [0, 0, 3.5], "radius": 0.5}  # 30 degrees per knot
    monkeypatch.setitem(tiny_datasets.MOTIONS, BRICK, MotionModel("ballistic_spin", **spin))
    monkeypatch.setattr(pose_repair, "ROUNDS", ())
    fast, errors = tiny_datasets.make_dataset(tmp_path), {}
    for wanted in ("true", "false"):
        settings = tiny_datasets.settings("train.iterations=300", f"train.repair={wanted}", "needs.residuals=off")
        made = Trainer(datasets.read(fast.root), settings)
        while made.iteration < 95:
            run.take_step(made, None, lambda event: None)
        true = np.stack([fast.turn(BRICK, t) for t in made.times])
        frame = rotations.multiply(rotations.conjugate(quats(made, BRICK)[made.first_time]), true[made.first_time])
        errors[wanted] = off(made, BRICK, rotations.multiply(true, rotations.conjugate(frame))).max()
    assert errors["true"] < 0.7 * errors["false"]


def test_poses_of_tracks_are_repaired_unless_switched_off(tiny):
    plan = {}
    for override in ("train.repair=false", "train.seed=0", "train.representation='field'"):
        settings = tiny_datasets.settings("train.repair=true", override)
        plan[override] = pose_repair.applies(Trainer(datasets.read(tiny.root), settings))
    assert list(plan.values()) == [False, True, False]

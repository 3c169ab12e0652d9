"""Gaussians that the field does not move become exactly static at their mean state."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.model.deformation import Deltas
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.motion import rotations
from r5dgs_core.train import checkpoint
from r5dgs_core.train.densification import densifier
from r5dgs_core.train.representations import gating
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

TIMES = np.linspace(0, 0.75, 6)
SHORT = ("train.representation='field'", "train.iterations=40", "field.trd_steps=20", "field.place_steps=20")


@dataclasses.dataclass
class Moving:
    """A motion that shifts, turns about x and stretches each Gaussian in proportion to time, after a constant shift."""

    shift: torch.Tensor  # [R]
    turn: torch.Tensor  # [R]
    stretch: torch.Tensor  # [R]
    constant: float = 0.3

    def at(self, means, t):
        zero = torch.zeros_like(self.shift)
        offsets = torch.stack([self.shift * t + self.constant, zero, zero], -1)
        quats = rotations.rotvecs_to_quats(torch.stack([self.turn * t + self.constant, zero, zero], -1))
        return Deltas(offsets, quats, (self.stretch * t)[:, None].expand(-1, 3))


def some_gaussians(n: int, size: float = 0.05) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    params = {
        "means": torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator),
        "log_scales": torch.full((n, 3), float(np.log(size))),
        "opacity_logits": torch.zeros(n),
        "sh": torch.zeros(n, 1, 3),
        "sh_rest": torch.zeros(n, 0, 3),
        "shading": torch.zeros(n, 3),
    }
    return Gaussians(params, torch.full((n,), 3))


def test_only_gaussians_that_move_stay_in_the_networks():
    gaussians = some_gaussians(7)
    shift, turn, stretch = torch.zeros(3, 7)
    shift[1], shift[2] = 0.001, 1.0
    turn[3], turn[4] = 0.01, 3.0  # a one-sigma radius of 0.05 makes the second an arc of more than the limit
    stretch[5], stretch[6] = 0.01, 1.0
    motion = Moving(shift, turn, stretch)
    before = motion.at(gaussians.means.detach(), 0.375)
    means, quats = gaussians.means.detach() + before.offsets, rotations.multiply(before.quats, gaussians.quats.detach())
    resting = gating.freeze_resting(gaussians, torch.arange(7), motion, TIMES, 0.01)
    assert resting.tolist() == [0, 1, 3, 5] == (gaussians.motion_ids == 0).nonzero()[:, 0].tolist()
    torch.testing.assert_close(gaussians.means.detach()[resting], means[resting], atol=1e-5, rtol=0)
    turned = (gaussians.quats.detach() * quats).sum(-1).abs() / quats.square().sum(-1)
    torch.testing.assert_close(turned[resting], torch.ones(4), atol=1e-5, rtol=0)
    moving = torch.tensor([2, 4, 6])
    untouched = some_gaussians(7)
    for name, value in gaussians.params.items():
        assert torch.equal(value[moving], untouched.params[name][moving])


@pytest.fixture(scope="module")
def unmasked(tmp_path_factory):
    return tiny_datasets.make_dataset(tmp_path_factory.mktemp("unmasked"), masks=False)


def make(data, *overrides) -> Trainer:
    return Trainer(datasets.read(data.root), tiny_datasets.settings(*SHORT, *overrides))


@pytest.mark.slow
def test_the_picture_does_not_jump_and_resting_gaussians_are_never_evaluated_again(unmasked):
    trainer = make(unmasked, "field.still=0.0")
    while not trainer.done:
        trainer.step()
    rows = trainer.motion.movers(trainer.gaussians)
    assert len(rows) == len(trainer.gaussians) and trainer.first_time == 2
    found = gating.mean_state(
        trainer.motion.motion, trainer.gaussians.means, trainer.gaussians.log_scales, trainer.times
    )
    limit = min(float(found.deviation.median()), 0.02)
    camera = trainer.views[0].camera
    with torch.no_grad():
        before = [trainer.splats(camera, float(t)).means for t in trainer.times]
    resting = gating.freeze_resting(trainer.gaussians, rows, trainer.motion.motion, trainer.times, limit)
    assert 0 < len(resting) < len(rows)
    moving = trainer.motion.movers(trainer.gaussians)
    assert sorted([*moving.tolist(), *resting.tolist()]) == rows.tolist()
    with torch.no_grad():
        after = [trainer.splats(camera, float(t)).means for t in trainer.times]
    assert all(torch.equal(a[resting], after[0][resting]) for a in after)
    assert all(torch.equal(a[moving], b[moving]) for a, b in zip(after, before, strict=True))
    assert max(float((a - b)[resting].norm(dim=1).max()) for a, b in zip(after, before, strict=True)) < 1.1 * limit
    densifier.grow(
        trainer.gaussians, trainer.optimizer, resting[:3], torch.zeros(3, dtype=torch.bool), trainer.generator
    )
    assert (trainer.gaussians.motion_ids[-3:] == 0).all()


def test_the_gate_closes_once_every_time_takes_part_and_a_resumed_run_does_the_same(unmasked, tmp_path):
    overrides = ("field.still=0.0027", "field.gate=0.5", "field.calm=0.0")
    trainer = make(unmasked, *overrides)
    states = {}
    for k in range(30):
        if k in (15, 25):
            states[k] = trainer.state()
        trainer.step()
        moving = len(trainer.motion.movers(trainer.gaussians))
        if k + 1 == 20:
            gated = moving
        assert (moving == len(trainer.gaussians)) == (k + 1 < 20)
    assert gated > 0
    expected = trainer.state()
    for k, state in states.items():
        checkpoint.save(tmp_path, state)
        again = make(unmasked, *overrides)
        again.restore(checkpoint.load(tmp_path))
        while again.iteration < 30:
            again.step()
        for name, tensor in again.state().tensors.items():
            assert torch.equal(tensor, expected.tensors[name]), (k, name)


@pytest.mark.slow
def test_labelled_gating_falls_back_to_measured_without_masks(unmasked, tiny):
    for data, expected in ((unmasked, "measured"), (tiny, "labelled")):
        trainer = make(data)
        assert gating.mover_rule(len(trainer.object_ids), trainer.config) == expected
    trainer = make(tiny, "field.movers='measured'")
    trainer.step()
    assert len(trainer.motion.movers(trainer.gaussians)) == len(trainer.gaussians)
    classes = trainer.motion.group_classes(trainer.motion.tensors())[trainer.gaussians.motion_ids]
    assert set(classes) == {0, 1, 2}
    late = tiny_datasets.settings(*SHORT, "field.gate=0.0")
    assert gating.gate_step(late) == late.curriculum.steps(40)[1] > 0

"""Identities in a whole training: resumed to the same bits, with the geometry or beside it, and baked."""

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import checkpoint, run
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

CHANGES = ("train.iterations=40", "identity.spatial=1.0", "identity.every=3", "identity.samples=100")


def make(data, training):
    return Trainer(datasets.read(data.root), tiny_datasets.settings(*CHANGES, f"identity.training={training}"))


def train_to(trainer, iteration):
    while trainer.iteration < iteration:
        trainer.step()
    return trainer


@pytest.mark.parametrize(("training", "broken_at"), [("joint", 20), ("detached", 9)])  # at 20 Gaussians just grew
def test_identities_resume_to_the_same_bits_together_with_the_geometry(tiny, tmp_path, training, broken_at):
    unbroken = train_to(make(tiny, training), broken_at)
    checkpoint.save(tmp_path, unbroken.state())
    resumed = make(tiny, training)
    resumed.restore(checkpoint.load(tmp_path))
    states = [train_to(trainer, 24).state() for trainer in (unbroken, resumed)]
    assert states[0].tensors.keys() == states[1].tensors.keys()
    for name, tensor in states[0].tensors.items():
        assert torch.equal(tensor, states[1].tensors[name]), name


def test_detached_identities_do_not_change_the_geometry_and_joint_ones_do(tiny):
    without, detached, joint = (train_to(make(tiny, how), 24) for how in ("off", "detached", "joint"))
    assert "identities" not in without.gaussians.params
    for name, values in without.gaussians.params.items():
        assert torch.equal(values, detached.gaussians.params[name]), name
    assert not torch.equal(without.gaussians.means, joint.gaussians.means[: len(without.gaussians)])


@pytest.mark.slow
@pytest.mark.default_cases("joint")
@pytest.mark.parametrize("training", ["joint", "detached", "off"])
def test_the_identities_of_a_run_are_stored_in_the_scene(tiny, tmp_path, training):
    settings = tiny_datasets.settings(*CHANGES, f"identity.training={training}")
    finished = run.train(tiny.root, tmp_path / "run", settings)
    scene = bake.bake(tiny_datasets.as_trained(finished), datasets.read(tiny.root))
    if training == "off":
        assert scene.gaussians.identities is None and scene.classifier is None
        return
    assert scene.gaussians.identities.shape == (len(scene.gaussians.means), 16) and scene.classifier.weight.shape == (
        3,
        16,
    )
    answers = (
        scene.gaussians.identities.astype(np.float32) @ scene.classifier.weight.T + scene.classifier.bias
    ).argmax(1)
    agreement = (answers == np.maximum(scene.gaussians.object_ids, 0)).mean()
    assert agreement > (0.5 if training == "joint" else 0.8)

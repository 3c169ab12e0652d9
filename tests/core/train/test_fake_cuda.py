"""A training step and a picture of each representation run on a CUDA device, as far as shapes and devices show."""

import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.train.trainer import Trainer
from tests.support import fake_cuda, tiny_datasets

pytestmark = pytest.mark.heavy

FIELD = ("train.representation=field", "field.place_steps=0", "field.trd_steps=0")
RUNS = {
    "still": ("needs.tracks=off",),
    "tracks": (),
    "tracks, harmonics": ("train.sh_degree=2",),
    "tracks, identities with the colours": ("identity.training=joint",),
    "tracks, identities beside": ("identity.training=detached", "identity.every=1"),
    "field": FIELD,
    "field of all, harmonics": (*FIELD, "field.movers=all", "train.sh_degree=1", "field.variant=r5dgs_extra"),
    "field, measured movers": (*FIELD, "field.movers=measured"),
}


@pytest.mark.default_cases(*RUNS)
@pytest.mark.parametrize("name", RUNS)
def test_a_step_and_a_picture_stay_on_the_device(tiny, name):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings("train.iterations=60", *RUNS[name]))
    trainer.motion.begin(trainer.gaussians, trainer.generator)
    rows = trainer.motion.movers(trainer.gaussians) if "field" in name else None
    with fake_cuda.mode():
        trainer._begin_on(fake_cuda.DEVICE)
        if rows is not None:  # their number depends on values
            trainer.motion._movers.of(trainer.gaussians.motion_ids, lambda _: rows.to(fake_cuda.DEVICE))
        trainer.iteration = 1
        loss = trainer.step()
        assert loss.device == fake_cuda.DEVICE
        for parameter, tensor in trainer.params.items():
            assert tensor.device == fake_cuda.DEVICE, parameter
        view = trainer.views[-1]
        with torch.no_grad():
            assert trainer.render(view.camera, view.t).device == fake_cuda.DEVICE

"""A step with several views moves along the mean of their gradients."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import TrainingError
from r5dgs_core.raster import RasterStats
from r5dgs_core.train import losses, view_batch
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

AT_ONCE = ("train.iterations=40", "curriculum.first=0", "curriculum.grow=0", "needs.residuals=off")


def make(data, *overrides):
    return Trainer(datasets.read(data.root), tiny_datasets.settings(*AT_ONCE, *overrides))


def step_with(trainer, *views):
    trainer.curriculum.queue = list(reversed(views))
    return float(trainer.step())


def params(trainer):
    return {name: tensor.detach().clone() for name, tensor in trainer.params.items()}


# Without random paths through the TRD.
FIELD = (
    "train.representation=field",
    "field.width=32",
    "field.place_steps=3",
    "field.trd_steps=0",
    "field.trd_share=0",
)


@pytest.mark.parametrize("motion", [("identity.training=off",), ("identity.training=joint",), FIELD])
def test_a_view_twice_is_the_view_once(tiny, motion):
    # Neighbouring Gaussians are drawn at random once for each view, and are left out here.
    common = (*motion, "identity.spatial=0", "identity.majority=0")
    one, two = make(tiny, *common), make(tiny, *common, "train.batch=2")
    for view in (3, 7, 5):
        assert step_with(two, view, view) == pytest.approx(step_with(one, view), rel=1e-5)
    expected = params(one)
    for name, tensor in params(two).items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-4, atol=2e-5, msg=name)


def test_the_loss_is_the_mean_over_the_views(tiny):
    trainer = make(tiny, "train.batch=3")
    step_with(trainer, 0, 1, 2)
    single = []
    with torch.no_grad():
        for index in (4, 9, 11):
            view = trainer.views[index]
            image = trainer.render(view.camera, view.t)
            single.append(float(losses.photometric(image, trainer.targets.of(index), trainer.config.losses.ssim)))
    assert step_with(trainer, 4, 9, 11) == pytest.approx(np.mean(single), rel=1e-5)


def test_penalties_that_depend_on_no_parameter_have_no_gradient(tiny):
    # One time alone has no roughness, and opacities have no weight.
    settings = tiny_datasets.settings("train.iterations=40", "train.batch=2", "densify.opacity=0")
    trainer = Trainer(datasets.read(tiny.root), settings)
    assert np.isfinite(float(trainer.step()))


def test_the_statistics_of_densification_count_each_view(tiny):
    trainer = make(tiny, "train.batch=2", "densify.start=1000")
    step_with(trainer, 0, 1)
    assert float(trainer.densifier.tensors()["gradients.views"].max()) == 2


def test_a_resumed_run_with_several_views_is_the_uninterrupted_one(tiny):
    settings = ("train.batch=2", "train.iterations=16", "densify.start=4", "densify.every=4")
    whole, first = make(tiny, *settings), make(tiny, *settings)
    for _ in range(9):
        whole.step()
        first.step()
    second = make(tiny, *settings)
    second.restore(first.state())
    while not whole.done:
        assert torch.equal(whole.step(), second.step())
    assert all(torch.equal(tensor, params(second)[name]) for name, tensor in params(whole).items())


@pytest.mark.parametrize(("mean", "other", "agree"), [(1.0, 1.0, True), (np.nan, np.nan, True), (1.0, 2.0, False)])
def test_only_processes_with_different_gaussians_are_refused(mean, other, agree):
    stats = RasterStats()
    stats.visible = stats.radii = stats.grad_norm = torch.ones(4)
    drawn = view_batch.Drawn(0, None, torch.ones(()), stats, None)

    def trainer_of(value, others=()):
        workers = SimpleNamespace(count=2, gather=lambda items: sent.extend(items) or [*items, *others])
        return SimpleNamespace(
            workers=workers, device="cpu", gaussians=SimpleNamespace(means=torch.full((4, 3), value))
        )

    sent = []
    view_batch._of_all(trainer_of(other), [drawn], "step 3")
    theirs = pickle.loads(pickle.dumps(sent))
    trainer = trainer_of(mean, theirs)
    if agree:
        assert len(view_batch._of_all(trainer, [drawn], "step 3")) == 2
    else:
        with pytest.raises(TrainingError, match="step 3: the processes of this run have different Gaussians"):
            view_batch._of_all(trainer, [drawn], "step 3")

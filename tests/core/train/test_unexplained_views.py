"""Training leaves out what moves although no mask names it, and nothing else."""

import dataclasses
import signal
import types

import numpy as np
import pytest
import torch
from scipy import ndimage

from r5dgs_core import errors
from r5dgs_core.bake import needs
from r5dgs_core.bake.draft import Context
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import masks, unexplained
from r5dgs_core.evaluation import evaluate, explained
from r5dgs_core.raster import RasterStats
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.train import checkpoint, checkpoint_content, losses, run, train_views, unexplained_views, view_psnr
from r5dgs_core.train.initialization import background_images
from r5dgs_core.train.normalization import Normalization
from r5dgs_core.train.step_graphs import StepInputs
from r5dgs_core.train.trainer import Trainer
from tests.support import passers_by, tiny_datasets


@pytest.fixture(scope="module")
def crossed(tiny, tmp_path_factory):
    """The tiny data set with a body that no mask names."""
    return passers_by.add(tiny.root, tmp_path_factory.mktemp("crossed") / "data")


def decided(dataset, *overrides, state=None):
    views = train_views.load(dataset, Normalization(np.zeros(3), 1.0), None)
    return views, *unexplained_views.decide(views, tiny_datasets.settings(*overrides), state)


def hidden(dataset, index):
    """The pixels of a training view that show the body. [H, W]"""
    view = dataset.train[index]
    shown = np.zeros((view.camera.height, view.camera.width), bool)
    shown[passers_by.place(view, passers_by.numbers(dataset)[index])] = True
    return shown & (datasets.load_mask(view) == 0)


def test_regions_of_a_body_without_a_mask_are_left_out(crossed):
    given, views, decision = decided(crossed)
    assert decision.on and decision.share > 0.03
    found = true = 0
    for index, (before, view) in enumerate(zip(given, views, strict=True)):
        assert (view.mask[view.unexplained] == masks.UNKNOWN).all()
        assert np.array_equal(view.mask[~view.unexplained], before.mask[~view.unexplained])
        assert view.image is before.image
        body = hidden(crossed, index)
        found, true = found + (view.unexplained & body).sum(), true + body.sum()
        assert not view.unexplained[~ndimage.binary_dilation(body, iterations=3)].any()
    assert found > 0.5 * true  # places that the objects mostly cover have no usual colours


def test_views_stay_the_same_if_masks_explain_what_moves(tiny):
    given, views, decision = decided(datasets.read(tiny.root))
    assert decision == unexplained_views.Decision(0.0, False)
    assert all(one is other for one, other in zip(given, views, strict=True))


def test_the_user_decides_before_the_measurement(tiny, crossed):
    assert decided(crossed, "needs.unexplained_regions=off")[2] is None
    assert not decided(crossed, "init.unexplained=0.5")[2].on
    assert decided(datasets.read(tiny.root), "needs.unexplained_regions=on")[2].on


def test_cameras_without_masks_or_with_few_frames_are_no_evidence(crossed):
    bare = dataclasses.replace(crossed, train=tuple(dataclasses.replace(v, mask_path=None) for v in crossed.train))
    assert decided(bare)[2] is None
    few = dataclasses.replace(crossed, train=crossed.train[:12])
    assert decided(few)[2] is None


def test_pixels_that_are_always_left_out_are_no_background(crossed):
    _, views, _ = decided(crossed)
    everything = np.ones(views[0].unexplained.shape, bool)
    mine = [dataclasses.replace(view, load_unexplained=lambda: everything) for view in views[::6]]
    assert not background_images.compute(mine)[0].known.any()


def of_run(decision):
    """Stand-in for a checkpoint with a decision, or with none."""
    return types.SimpleNamespace(tensors={checkpoint_content.UNEXPLAINED: decision.tensor()} if decision else {})


def test_a_resumed_run_keeps_its_decision(crossed, tiny):
    kept = unexplained_views.Decision(0.02, True)
    _, views, decision = decided(crossed, state=of_run(kept))
    assert decision == kept and all(view.load_unexplained is not None for view in views)
    dropped = unexplained_views.Decision(0.2, False)
    for state, expected in ((of_run(dropped), dropped), (of_run(None), None)):  # the last one is of an older release
        _, views, decision = decided(crossed, state=state)
        assert decision == expected and all(view.load_unexplained is None for view in views)


@pytest.mark.heavy
def test_resuming_does_not_search_again(crossed, tmp_path, monkeypatch):
    def stop(event):
        if event.get("iteration", 0) >= 20:
            signal.raise_signal(signal.SIGINT)

    settings = tiny_datasets.settings("train.iterations=30", "init.unexplained=0.5")
    with pytest.raises(errors.Interrupted):
        run.train(crossed.root, tmp_path / "run", settings, progress=stop)
    before = checkpoint.load(tmp_path / "run").tensors[checkpoint_content.UNEXPLAINED]
    monkeypatch.setattr(unexplained, "of_cameras", lambda *_: pytest.fail("searched again"))
    run.train(crossed.root, tmp_path / "run", settings, resume=True)
    assert torch.equal(checkpoint.load(tmp_path / "run").tensors[checkpoint_content.UNEXPLAINED], before)


def test_left_out_pixels_change_neither_the_loss_nor_its_gradient():
    rng = np.random.default_rng(0)
    picture, target = (torch.from_numpy(rng.random((16, 16, 3), np.float32)) for _ in range(2))
    region = np.zeros((16, 16), bool)
    region[3:7, 5:12] = True
    inside = torch.from_numpy(region)[..., None]
    found = []
    for given in (target, torch.where(inside, 1 - target, target), torch.where(inside, target, 1 - target)):
        image = picture.clone().requires_grad_()
        loss = losses.photometric(image, given, 0.2, region)
        (gradient,) = torch.autograd.grad(loss, image)
        assert not gradient[region].any() and gradient[~region].any()
        found.append((loss.item(), gradient))
    assert found[0][0] == found[1][0] and torch.equal(found[0][1], found[1][1])
    assert found[0][0] != found[2][0]


@pytest.mark.slow
@pytest.mark.heavy
def test_pixels_of_the_regions_have_no_effect_on_a_step(crossed):
    trainer = Trainer(crossed, tiny_datasets.settings("train.iterations=10"))
    view, region = trainer.views[0], trainer.given_views[0].unexplained
    path = trainer.motion.path(view.t, trainer.generator)
    target = trainer.targets.of(0)
    changed = torch.where(torch.from_numpy(region)[..., None], 1 - target, target)
    outside = torch.where(torch.from_numpy(~region)[..., None], 1 - target, target)
    found = []
    for one in (target, changed, outside):
        loss, _, _ = trainer.compare(StepInputs(0, view, path, one), RasterStats(), "")
        found.append((float(loss.detach()), torch.autograd.grad(loss, trainer.gaussians.params["means"])[0]))
    assert found[0][0] == found[1][0] and torch.equal(found[0][1], found[1][1])
    assert found[0][0] != found[2][0]


@pytest.mark.heavy
def test_the_decision_is_kept_in_checkpoints_and_in_the_table_of_needs(crossed):
    settings = tiny_datasets.settings("train.iterations=10")
    trainer = Trainer(crossed, settings)
    tensors = trainer.state().tensors
    assert unexplained_views.Decision.of(tensors[checkpoint_content.UNEXPLAINED]) == trainer.unexplained
    row = needs.left_out(tensors, settings).row()
    assert (row["name"], row["decision"], row["threshold"]) == (unexplained.NEED, "on", 0.03)
    assert row["value"] == trainer.unexplained.share
    assert needs.left_out({}, config.Config()).row()["reason"] == "not examined"
    late = needs.left_out(tensors, settings.replace(**{"needs.unexplained_regions": "off"})).row()
    assert late["decision"] == "on"
    assert late["reason"].startswith("set off by the user, but training has decided otherwise; share")


def test_the_evaluation_measures_the_explained_regions_on_their_own(crossed):
    scene = tiny_datasets.make_truth()
    seen = dataclasses.replace(crossed, val=crossed.train[:12], test=())
    plain = evaluate.evaluate(scene, seen, splits=("val",))["splits"]["val"]["rigid"]
    assert plain["psnr_explained"] is None
    need = {"name": unexplained.NEED, "decision": "on", "value": 0.06, "threshold": 0.03, "reason": ""}
    left_out = dataclasses.replace(scene, needs=(need,))
    found = evaluate.evaluate(left_out, seen, splits=("val",))["splits"]["val"]["rigid"]
    assert found["psnr"] == plain["psnr"]
    assert found["psnr_explained"] > found["psnr"] + 2
    unknown = dataclasses.replace(seen, val=tuple(dataclasses.replace(v, mask_path=None) for v in seen.val))
    assert evaluate.evaluate(left_out, unknown, splits=("val",))["splits"]["val"]["rigid"]["psnr_explained"] is None


def test_training_and_evaluation_find_the_same_regions(crossed):
    need = {"name": unexplained.NEED, "decision": "on"}
    scene = dataclasses.replace(tiny_datasets.make_truth(), needs=(need,))
    pixels = explained.pixels(scene, crossed, np.ones(3))
    _, views, _ = decided(crossed)
    for view, given in zip(views, crossed.train, strict=True):
        found = pixels.of(given, datasets.load_image(given), datasets.load_mask(given))
        assert np.array_equal(view.unexplained, ~found)


def test_baking_finds_the_regions_of_the_run(crossed):
    """Also if its data set has corrected cameras."""
    _, views, decision = decided(crossed)
    bright = dataclasses.replace(Correction(), gain=1.2 * np.eye(3))
    corrected = dataclasses.replace(
        crossed, train=tuple(dataclasses.replace(view, correction=bright) for view in crossed.train)
    )
    run_of = types.SimpleNamespace(config=tiny_datasets.settings())
    context = Context(run_of, of_run(decision), corrected, Normalization(np.zeros(3), 1.0), crossed)
    for view, one in zip(views, corrected.train, strict=True):
        assert np.array_equal(view.unexplained, ~context.explained(one, datasets.load_given_image(one)))
    dropped = dataclasses.replace(context, state=of_run(unexplained_views.Decision(0.2, False)))
    assert dropped.explained(corrected.train[0], datasets.load_given_image(corrected.train[0])) is None


def test_baking_reads_each_image_once_per_comparison(crossed, monkeypatch):
    """The usual colours of the cameras are computed before."""
    _, _, decision = decided(crossed)
    run_of = types.SimpleNamespace(config=tiny_datasets.settings())
    context = Context(run_of, of_run(decision), crossed, Normalization(np.zeros(3), 1.0), crossed)
    context.explained(crossed.train[0], datasets.load_given_image(crossed.train[0]))
    read, load, some = [], datasets.load_rgba, dataclasses.replace(crossed, train=crossed.train[:4])
    monkeypatch.setattr(datasets, "load_rgba", lambda view: read.append(view.name) or load(view))
    black = np.zeros((some.train[0].camera.height, some.train[0].camera.width, 3))
    view_psnr.training_psnr(some, None, lambda view: black, context.explained)
    assert read == [view.name for view in some.train]


def test_baking_reads_no_masks_of_cameras_without_usual_colours(crossed, monkeypatch):
    _, _, decision = decided(crossed)
    unmasked = dataclasses.replace(
        crossed, train=tuple(dataclasses.replace(view, mask_path=None) for view in crossed.train)
    )
    run_of = types.SimpleNamespace(config=tiny_datasets.settings())
    context = Context(run_of, of_run(decision), unmasked, Normalization(np.zeros(3), 1.0), unmasked)
    read, image = [], datasets.load_given_image(crossed.train[0])
    monkeypatch.setattr(datasets, "load_mask", lambda view, *_: read.append(view.name))
    assert [context.explained(view, image) for view in unmasked.train] == [None] * len(unmasked.train)
    assert not read

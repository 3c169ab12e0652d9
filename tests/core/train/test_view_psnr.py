"""Measuring held-out views shows the progress of a run and does not change its result."""

import json

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate
from r5dgs_core.train import checkpoint, run, run_folder, view_psnr
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy


def events_of(root, folder, *overrides):
    found = []
    settings = tiny_datasets.settings("train.iterations=45", "identity.iterations=3", *overrides)
    run.train(root, folder, settings, progress=found.append)
    return [event for event in found if event["event"] == "step"]


def test_measuring_held_out_views_does_not_change_a_run(tiny, tmp_path):
    looking = events_of(tiny.root, tmp_path / "looking", "train.probe_every=7")
    blind = events_of(tiny.root, tmp_path / "blind", "train.probe_every=0")
    ours, theirs = (checkpoint.load(tmp_path / name) for name in ("looking", "blind"))
    assert all(torch.equal(ours.tensors[name], tensor) for name, tensor in theirs.tensors.items())
    assert ours.tensors.keys() == theirs.tensors.keys() and ours.running_loss == theirs.running_loss
    seen = [event["iteration"] for event in looking if "val_psnr" in event]
    assert seen == [7, 14, 21, 28, 35, 42, 45] and not any("val_psnr" in event for event in blind)
    logged = [json.loads(line) for line in (tmp_path / "looking" / run_folder.LOG_FILE).read_text().splitlines()]
    assert logged == looking and {10, 20, 30, 40} < {event["iteration"] for event in logged}


@pytest.mark.slow
def test_training_raises_the_psnr_of_held_out_views(tiny, tmp_path):
    found = [e["val_psnr"] for e in events_of(tiny.root, tmp_path / "run", "train.probe_every=5") if "val_psnr" in e]
    assert 5 < found[0] < found[-1] < 60


def test_the_measurement_agrees_with_the_evaluation(tiny, trained, baked):
    dataset = datasets.read(tiny.root)
    trainer = Trainer(dataset, trained.config)
    trainer.restore(checkpoint.load(trained.folder))
    measurement = view_psnr.HeldOutPsnr(trainer, 5)
    assert len(measurement) == len(dataset.val) == 2
    result = evaluate.evaluate(baked, dataset)
    assert measurement.measure() == pytest.approx(result["splits"]["val"]["rigid"]["psnr"], abs=0.1)


def test_the_number_of_measured_views_is_limited(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings())
    assert len(view_psnr.HeldOutPsnr(trainer, 1)) == 1


def test_without_held_out_views_nothing_is_measured(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path / "data", views=3)
    (data.root / "transforms_val.json").unlink()
    steps = events_of(data.root, tmp_path / "run", "train.probe_every=1", "train.iterations=3")
    assert [event["iteration"] for event in steps] == [3] and "val_psnr" not in steps[0]


@pytest.mark.parametrize("levels", [1, 10, 255])
def test_the_psnr_of_a_constant_error_is_exact(levels):
    target = np.zeros((4, 5, 3), np.uint8)
    image = np.full((4, 5, 3), levels / 255, np.float32)
    assert view_psnr.psnr_8_bit(image, target) == pytest.approx(20 * np.log10(255 / levels))
    assert view_psnr.psnr_8_bit(target.astype(np.float32), target) == 99


def test_the_psnr_counts_only_the_pixels_of_a_mask():
    target, where = np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), bool)
    where[1:3, 2:4] = True
    image = np.where(where[..., None], np.float32(10 / 255), np.float32(1))
    assert view_psnr.psnr_8_bit(image, target, where) == pytest.approx(20 * np.log10(255 / 10))

"""Objects without masks: found by their motion, then trained as if masks had shown them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.config import training_needs
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate
from r5dgs_core.scene import validation
from r5dgs_core.train import checkpoint, checkpoint_content, object_discovery, run, run_folder
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

BRIEF = ("train.iterations=60", "identity.iterations=0")


@pytest.fixture(scope="module")
def unmasked(tmp_path_factory):
    return tiny_datasets.make_dataset(tmp_path_factory.mktemp("unmasked"), masks=False)


def true_masks(tiny):
    return [datasets.load_mask(view) for view in datasets.read(tiny.root).train]


def overlap(found, truth, a, b):
    """Intersection over union of the id ``a`` of some masks and the id ``b`` of others, over all of them."""
    inside = sum(((f == a) & (t == b)).sum() for f, t in zip(found, truth, strict=True))
    return inside / sum(((f == a) | (t == b)).sum() for f, t in zip(found, truth, strict=True))


@pytest.mark.nightly
def test_moving_objects_are_found_and_separated(unmasked, tiny):
    config = tiny_datasets.settings("discovery.iterations=1000", "densify.stop=0.6")
    events = []
    found = object_discovery.find_masks(datasets.read(unmasked.root), config, events.append)
    assert found is not None and [event["event"] for event in events] == ["prepare", "prepare"]
    truth = true_masks(tiny)
    ids = range(1, max(int(mask.max()) for mask in found) + 1)
    best = {b: max((overlap(found, truth, a, b), a) for a in ids) for b in (tiny_datasets.BRICK, tiny_datasets.BALL)}
    assert min(share for share, _ in best.values()) > 0.35
    assert len({a for _, a in best.values()}) == 2


def test_a_run_searches_only_if_necessary(unmasked, tiny):
    config = tiny_datasets.settings()
    assert training_needs.discovery(datasets.read(unmasked.root), config)
    assert not training_needs.discovery(datasets.read(tiny.root), config)
    for off in ("discovery.iterations=0", "needs.tracks='off'", "train.representation='field'"):
        assert not training_needs.discovery(datasets.read(unmasked.root), tiny_datasets.settings(off))
        assert object_discovery.find_masks(datasets.read(unmasked.root), tiny_datasets.settings(off)) is None
    field = tiny_datasets.settings("train.representation='field'", "field.tracks_share=0.2")
    assert training_needs.discovery(datasets.read(unmasked.root), field)


def test_static_scenes_get_no_masks(unmasked, monkeypatch):
    monkeypatch.setattr(object_discovery, "find_parts", lambda trainer, config: np.full(len(trainer.gaussians), -1))
    config = tiny_datasets.settings("discovery.iterations=2")
    assert object_discovery.find_masks(datasets.read(unmasked.root), config) is None


def test_found_masks_start_a_run_like_given_ones(unmasked, tiny):
    config, truth = tiny_datasets.settings(*BRIEF), true_masks(tiny)
    found, given = Trainer(datasets.read(unmasked.root), config, truth), Trainer(datasets.read(tiny.root), config)
    for name, value in given.gaussians.params.items():
        assert torch.equal(found.gaussians.params[name], value)
    assert torch.equal(found.gaussians.motion_ids, given.gaussians.motion_ids)
    assert all(view.mask is None for view in found.views) and found.object_ids.tolist() == [0, 1, 2]


@pytest.mark.slow
def test_a_resumed_run_keeps_the_masks_that_it_began_with(unmasked, tiny, tmp_path, monkeypatch):
    calls = []

    def find(dataset, config, progress):
        calls.append(config)
        return true_masks(tiny)

    monkeypatch.setattr(object_discovery, "find_masks", find)
    config = tiny_datasets.settings(*BRIEF, "train.checkpoint_every=20")
    whole = run.train(unmasked.root, tmp_path / "whole", config)
    expected = checkpoint.load(whole.folder).tensors
    half = Trainer(datasets.read(unmasked.root), config, true_masks(tiny))
    parted = run_folder.create_run(tmp_path / "parted", datasets.read(unmasked.root), config)
    while half.iteration < 20:
        half.step()
    checkpoint.save(parted.folder, half.state())
    run.train(unmasked.root, parted.folder, config, resume=True)
    found = checkpoint.load(parted.folder).tensors
    assert len(calls) == 1 and found.keys() == expected.keys() and checkpoint_content.DISCOVERED_MASKS in found
    for name, tensor in expected.items():
        np.testing.assert_array_equal(found[name].numpy(), tensor.numpy(), err_msg=name)

    scene = bake.bake(whole)
    validation.check(scene, "scene")
    assert [item.name for item in scene.objects] == ["background", "object 1", "object 2"]
    assert scene.provenance["discovered"] and scene.classifier is None
    shadows = {group.id for group in scene.groups if group.role == "shadow"}
    bodies = ~np.isin(scene.gaussians.motion_ids, list(shadows))
    np.testing.assert_array_equal(scene.gaussians.object_ids[bodies], scene.gaussians.motion_ids[bodies])


def test_the_short_run_uses_the_settings_of_the_run(unmasked):
    config = tiny_datasets.settings("densify.max_gaussians=900", "train.background='white'", "train.seed=7")
    short = object_discovery._short(config, 0.75)
    assert short.train.representation == "field" and short.densify.max_gaussians == 900
    assert short.train.background == "white" and short.train.seed == 7


def test_found_objects_are_measured_against_the_true_ones(tiny):
    truth = datasets.read(tiny.root).ground_truth
    strange = dataclasses.replace(truth, object_ids=truth.object_ids[::-1])
    named = evaluate.object_errors(tiny.truth, strange)
    found = evaluate.object_errors(dataclasses.replace(tiny.truth, provenance={"discovered": True}), strange)
    assert min(row["position_error"] for row in named) > 0.1
    assert max(row["position_error"] for row in found) < 1e-3 and [row["id"] for row in found] == [1, 2]


@pytest.mark.slow
def test_a_field_without_masks_groups_moving_gaussians_at_the_end(unmasked, tmp_path, monkeypatch):
    """The parts become objects with groups of their own, and nobody takes their ids for those of the data."""
    config = tiny_datasets.settings(
        "train.representation='field'", "field.size='small'", "train.iterations=60", "densify.stop=0.6"
    )
    sorted_ones = []

    def sort(trainer):
        x = trainer.gaussians.means.detach().numpy()[:, 0]
        labels = np.where(x > 0.5, 0, np.where(x < -0.5, 1, -1))
        sorted_ones.append(labels)
        return labels

    monkeypatch.setattr(object_discovery, "sort_into_parts", sort)
    events = []
    made = run.train(unmasked.root, tmp_path / "run", config, progress=events.append)
    assert "2 moving parts found" in [event["text"] for event in events if event["event"] == "prepare"][-1]
    tensors = checkpoint.load(made.folder).tensors
    assert tensors["object_ids"].tolist() == [0, 1, 2] and checkpoint_content.DISCOVERED_LABELS in tensors
    scene = bake.bake(made)
    validation.check(scene, "scene")
    assert [item.name for item in scene.objects] == ["background", "object 1", "object 2"]
    assert scene.provenance["discovered"] and scene.classifier is None
    counts = {item.id: item.count for item in scene.objects}
    (labels,) = sorted_ones
    assert counts == {k: int((labels == k - 1).sum()) for k in range(3)}
    assert {group.role for group in scene.groups if group.object_id > 0} >= {"body"}
    again = run.train(unmasked.root, tmp_path / "run", config, resume=True)
    assert len(sorted_ones) == 1 and checkpoint.load(again.folder).finished


def test_a_field_is_clustered_only_without_other_groups(unmasked, tiny):
    data = datasets.read(unmasked.root)
    field = "train.representation='field'"
    assert training_needs.sorting(data, tiny_datasets.settings(field))
    assert not training_needs.sorting(data, tiny_datasets.settings())
    assert not training_needs.sorting(datasets.read(tiny.root), tiny_datasets.settings(field))
    for off in ("discovery.iterations=0", "needs.tracks='off'", "field.tracks_share=0.2"):
        assert not training_needs.sorting(data, tiny_datasets.settings(field, off))


@pytest.mark.nightly
def test_the_parts_of_a_field_are_the_objects(unmasked, tiny, tmp_path):
    config = tiny_datasets.settings(
        "train.representation='field'", "field.size='small'", "train.iterations=1000", "densify.stop=0.6"
    )
    scene = bake.bake(run.train(unmasked.root, tmp_path / "run", config))
    shown = [evaluate.render(scene, v.camera, v.t).ids for v in datasets.read(unmasked.root).train]
    truth = true_masks(tiny)
    ids = range(1, len(scene.objects))
    best = {b: max((overlap(shown, truth, a, b), a) for a in ids) for b in (tiny_datasets.BRICK, tiny_datasets.BALL)}
    assert min(share for share, _ in best.values()) > 0.3
    assert len({a for _, a in best.values()}) == 2

"""Corrections of cameras: their gradients, their gauge, and a run that recovers wrong cameras and resumes exactly."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.raster import rasterize_splats
from r5dgs_core.scene import cameras
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.train import checkpoint_content, run, train_views
from r5dgs_core.train.refinement import gauge, gradients, patch_trial, refined_dataset, rig, trial
from r5dgs_core.train.refinement.refinement import PARTS, Refinement
from r5dgs_core.train.representations.fused_posing import PosedSplats
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

STEPS = ("train.iterations=160", "needs.residuals=off", "train.probe_every=0")


def jittered(data, sizes, seed=0):
    """The data set with wrong cameras: rotations (rad) and colours (gain)."""
    rng, turn, gain = np.random.default_rng(seed), sizes.get("turn", 0.0), sizes.get("gain", 0.0)
    given = datasets.read(data.root)
    names = sorted({v.camera.name for v in given.train})
    wrong = {name: Correction(rotvec=rng.normal(0, turn, 3)) for name in names}
    gains = {name: 1 + gain * rng.choice([-1, 1], 3) for name in names}
    train = tuple(dataclasses.replace(v, camera=wrong[v.camera.name].camera(v.camera)) for v in given.train)
    return dataclasses.replace(given, train=train), gains


def train(dataset, *overrides, gains=None, stop=None):
    trainer = Trainer(dataset, tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS, *overrides))
    if gains is not None:
        for index, view in enumerate(trainer.given_views):
            image = np.clip(np.round(view.image * gains[view.camera.name]), 0, 255).astype(np.uint8)
            trainer.given_views[index] = view.with_arrays(image)
    while not trainer.done and trainer.iteration != stop:
        run.take_step(trainer, None, lambda event: None)
    return trainer


def offsets(dataset, trainer, truth):
    """Distances of images of points in the training cameras from those in the true ones, px. [V]"""
    found = refined_dataset.corrections(dataset, trainer.refinement.tensors(), trainer.normalization)
    refined = refined_dataset.apply(dataset, found)
    points = np.random.default_rng(0).normal([0, 0, 0.4], 0.5, (200, 3))
    result = []
    for view, true in zip(refined.train, truth.train, strict=True):
        before, after = (cameras.project(camera, points)[0] for camera in (view.camera, true.camera))
        result.append(np.sqrt(((before - after) ** 2).sum(1).mean()))
    return np.array(result)


@pytest.fixture(scope="module")
def wrong(tiny):
    return jittered(tiny, {"turn": 0.015}, seed=3)


@pytest.fixture(scope="module")
def refined(wrong):
    return train(wrong[0])


def test_gradients_of_the_camera_are_those_of_the_picture():
    rng = np.random.default_rng(3)
    camera = tiny_datasets.orbit_camera(0.4, 24, 18)
    n = 30
    means = torch.from_numpy(rng.normal([0, 0, 0.45], 0.4, (n, 3)))
    quats, scales = torch.from_numpy(rng.normal(size=(n, 4))), torch.from_numpy(rng.uniform(0.1, 0.3, (n, 3)))
    colors, weights = torch.from_numpy(rng.uniform(size=(n, 3))), torch.from_numpy(rng.normal(size=(18, 24, 3)))
    weights = weights.cumsum(0).cumsum(1) / 100
    opacities = torch.full((n,), 0.5, dtype=torch.float64)
    quats = quats / quats.norm(dim=1, keepdim=True)
    splats = PosedSplats(*(t.requires_grad_(True) for t in (means, quats, scales)), opacities, colors)

    def loss(correction):
        seen = correction.camera(camera)
        image = rasterize_splats(means, quats, scales, opacities, colors, seen, backend="reference").image
        return (image * weights).sum()

    loss(Correction()).backward()
    view = dataclasses.make_dataclass("View", ["camera"])(camera)
    with torch.no_grad():
        by_pose, by_focal = gradients.camera_gradient(view, splats, np.zeros(3))
        step = 1e-5
        numeric = [
            float(loss(Correction().plus(step * unit)) - loss(Correction().plus(-step * unit))) / (2 * step)
            for unit in np.eye(20)[:7]
        ]
    np.testing.assert_allclose(by_pose, numeric[:6], rtol=0.05, atol=0.02 * np.abs(numeric[:6]).max())
    assert by_focal == pytest.approx(numeric[6], rel=0.1)


@pytest.mark.slow
def test_wrong_poses_are_found_and_corrected(tiny, wrong, refined):
    assert "camera_poses" in refined.refinement.parts
    truth = datasets.read(tiny.root)
    untouched = train(wrong[0], *(f"needs.{part}=off" for part in PARTS))
    assert offsets(wrong[0], refined, truth).mean() < 0.7 * offsets(wrong[0], untouched, truth).mean()


@pytest.mark.slow
def test_right_cameras_are_left_alone_and_the_run_is_the_same(tiny):
    dataset = datasets.read(tiny.root)
    end = trial.steps(tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS))[-1] + 1
    tried = train(dataset, stop=end)
    assert tried.refinement.gains is not None and not tried.refinement.active
    plain = train(dataset, *(f"needs.{part}=off" for part in PARTS), stop=end).state()
    for name, tensor in plain.tensors.items():
        assert torch.equal(tensor, tried.state().tensors[name]), name


@pytest.mark.slow
def test_wrong_colours_are_found_and_corrected(tiny):
    dataset, gains = jittered(tiny, {"gain": 0.15})
    trainer = train(dataset, gains=gains)
    assert "camera_colours" in trainer.refinement.parts
    names = trainer.refinement.rig.names
    found = np.stack([np.diag(trainer.refinement.correction(row).gain) for row in range(len(names))])
    true = np.stack([gains[name] for name in names])
    before, after = (np.abs(gain / gain.mean(0) - true / true.mean(0)).mean() for gain in (np.ones_like(true), found))
    assert after < 0.8 * before


def test_colours_are_corrected_before_gaussians_are_placed(tiny, monkeypatch):
    dataset, gains = jittered(tiny, {"gain": 0.15})
    load = train_views.load

    def recolored(*arguments):
        return [
            view.with_arrays(np.clip(np.round(view.image * gains[view.camera.name]), 0, 255).astype(np.uint8))
            for view in load(*arguments)
        ]

    monkeypatch.setattr(train_views, "load", recolored)
    trainer = Trainer(dataset, tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS))
    assert trainer.refinement.parts == {"camera_colours"}
    names = trainer.refinement.rig.names

    def error(trainer):
        found = np.stack([np.diag(trainer.refinement.correction(row).gain) for row in range(len(names))])
        true = np.stack([gains[name] for name in names])
        return np.abs(found / found.mean(0) - true / true.mean(0)).mean()

    untouched = np.mean([np.abs(gain - 1) for gain in gains.values()])
    assert error(trainer) < 0.5 * untouched
    resumed = Trainer(dataset, trainer.config)
    resumed.restore(trainer.state())
    for _ in range(3):
        run.take_step(trainer, None, lambda event: None)
        run.take_step(resumed, None, lambda event: None)
    found = resumed.state().tensors
    for name, tensor in trainer.state().tensors.items():
        assert torch.equal(tensor, found[name]) or name in ("refine.gains", "refine.sizes"), name
    off = Trainer(dataset, tiny_datasets.settings(*STEPS, "needs.camera_colours=off"))
    assert not off.refinement.active


def test_parts_that_were_not_examined_do_not_stop_a_checkpoint(tiny):
    held = Refinement(rig.of(datasets.read(tiny.root).train), 0.1, 100)
    held.learn({"camera_colours": (0.1, 3.0)})
    tensors = held.tensors()
    unknown = {name for name, tensor in tensors.items() if tensor.isnan().any()}
    assert unknown and unknown <= set(checkpoint_content.MAY_BE_NAN)
    other = Refinement(held.rig, 0.1, 100)
    other.restore(tensors)
    np.testing.assert_array_equal(other.sizes, held.sizes)


def test_training_does_not_change_settled_parts(tiny):
    held = Refinement(rig.of(datasets.read(tiny.root).train), 0.1, 100)
    rng = np.random.default_rng(0)
    held.learn({part: (1.0, 1.0) for part in PARTS})
    held.change({"camera_poses": rng.normal(0, 0.01, (held.rig.poses, 6))}, final=True)
    held.begin(["camera_poses", "time_offsets"], rng.normal(size=(50, 3)), 0, {})
    other = Refinement(held.rig, 0.1, 100)
    other.restore(held.tensors())
    for one in (held, other):
        before = [one.correction(row) for row in range(one.rig.poses)]
        for index in range(len(one.rig.pose_of)):
            sign = (-1.0) ** one.rig.lens_of[index]
            one.apply(index, 32, np.append(np.full(8, sign), np.full(6, np.nan)), 1)
        after = [one.correction(row) for row in range(one.rig.poses)]
        assert any(a.rotvec.any() for a in after) and any(a.time != b.time for a, b in zip(after, before, strict=True))
        np.testing.assert_allclose([a.rotvec for a in after], [b.rotvec for b in before], atol=1e-12)
        np.testing.assert_allclose([a.shift for a in after], [b.shift for b in before], atol=1e-12)


@pytest.mark.parametrize("final", [True, False])
def test_an_adjustment_to_patches_replaces_training_once_it_is_final(tiny, monkeypatch, final):
    first, second = trial.steps(tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS))[:2]
    change, calls = {}, []

    def adjust(trainer, points):
        calls.append(trainer.iteration)
        change.setdefault("camera_poses", np.random.default_rng(0).normal(0, 0.01, (trainer.refinement.rig.poses, 6)))
        return patch_trial.Found(change if len(calls) == 1 else {"camera_poses": 0.0 * change["camera_poses"]}, final)

    monkeypatch.setattr(patch_trial, "adjust", adjust)
    rest = (f"needs.{part}=off" for part in PARTS[1:])
    trainer = train(datasets.read(tiny.root), "needs.camera_poses=on", *rest, stop=second + 1)
    held = trainer.refinement
    assert calls == ([first] if final else [first, second])
    kept = gauge.Gauge(held.rig.cameras, held.tensors()["refine.units"].numpy()).fix(change["camera_poses"])
    found = np.array([[*held.correction(row).rotvec, *held.correction(row).shift] for row in range(held.rig.poses)])
    assert np.allclose(found, kept, atol=1e-9) == final


def test_adjusted_clocks_are_adjusted_once_more_when_the_motion_is_known(tiny, monkeypatch):
    due, calls = trial.steps(tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS))[2], []

    def adjust(trainer, points):
        count = trainer.refinement.rig.poses
        return patch_trial.Found({"camera_poses": np.zeros((count, 6)), "time_offsets": np.zeros(count)}, True)

    def adjust_clocks(trainer, points):
        calls.append(trainer.iteration)
        return 0.01 * np.arange(trainer.refinement.rig.poses)

    monkeypatch.setattr(patch_trial, "adjust", adjust)
    monkeypatch.setattr(patch_trial, "adjust_clocks", adjust_clocks)
    trainer = train(datasets.read(tiny.root), "needs.camera_poses=on", "needs.camera_colours=off")
    times = [trainer.refinement.correction(row).time for row in range(trainer.refinement.rig.poses)]
    assert calls == [due]
    assert np.allclose(np.diff(times), 0.01)


def test_pictures_that_share_too_little_adjust_nothing(tiny):
    trainer = train(datasets.read(tiny.root), *(f"needs.{part}=off" for part in PARTS[:3]), stop=5)
    assert patch_trial.adjust(trainer, trainer.gaussians.means.detach().numpy()) is None


@pytest.mark.slow
def test_a_restored_run_continues_exactly(wrong, refined):
    half = train(wrong[0], stop=90)
    resumed = Trainer(wrong[0], half.config)
    resumed.restore(half.state())
    while not resumed.done:
        run.take_step(resumed, None, lambda event: None)
    expected, found = refined.state().tensors, resumed.state().tensors
    assert expected.keys() == found.keys() and any(name.startswith("refine.") for name in expected)
    for name, tensor in expected.items():
        assert torch.equal(tensor, found[name]), name


@pytest.mark.slow
def test_means_of_focal_lengths_clocks_and_colours_stay(refined):
    held = refined.refinement
    corrections = [held.correction(row) for row in range(held.rig.poses)]
    np.testing.assert_allclose(np.mean([c.gain for c in corrections], 0), np.eye(3), atol=1e-9)
    assert np.mean([c.time for c in corrections]) == pytest.approx(0, abs=1e-12)
    assert np.mean([c.log_focal for c in corrections]) == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_views_have_the_corrected_cameras(refined):
    row = int(refined.refinement.rig.pose_of[3])
    expected = refined.refinement.correction(row).camera(refined.given_views[3].camera)
    np.testing.assert_array_equal(refined.views[3].camera.T_cam_world, expected.T_cam_world)
    assert len(refined.views[:4]) == 4


def test_cameras_are_never_examined_if_everything_is_switched_off():
    config = tiny_datasets.settings(*STEPS, *(f"needs.{part}=off" for part in PARTS))
    assert trial.steps(config) == ()
    assert trial.steps(tiny_datasets.settings("train.iterations=99")) == ()
    assert all(0 < step < 160 for step in trial.steps(tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS)))


def test_a_run_without_examinations_keeps_the_colours_that_it_began_with():
    config = tiny_datasets.settings("train.iterations=99")
    trial.after_step(SimpleNamespace(config=config, iteration=10, refinement=SimpleNamespace(active=True)))


def test_a_part_set_on_is_refined_without_need(tiny):
    second = trial.steps(tiny_datasets.settings(*tiny_datasets.EXAMINED, *STEPS))[1]
    trainer = train(datasets.read(tiny.root), "needs.time_offsets=on", "needs.camera_poses=off", stop=second + 1)
    assert "time_offsets" in trainer.refinement.parts

"""Training recovers a known motion, resumes exactly from a saved state, and stops at the first NaN."""

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import TrainingError
from r5dgs_core.motion import rotations
from r5dgs_core.train import checkpoint, losses
from r5dgs_core.train.representations import tracks
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

SHORT = ("train.iterations=60",)


def make(data, *overrides):
    return Trainer(datasets.read(data.root), tiny_datasets.settings(*SHORT, *overrides))


def mean_loss(trainer):
    with torch.no_grad():
        values = [
            float(losses.photometric(trainer.render(v.camera, v.t), torch.from_numpy(v.image).float() / 255, 0.2))
            for v in trainer.views
        ]
    return np.mean(values)


def assert_same_state(a, b):
    assert a.tensors.keys() == b.tensors.keys()
    for name, tensor in a.tensors.items():
        assert torch.equal(tensor, b.tensors[name]), name
    assert torch.equal(a.observed, b.observed)
    for name in {field.name for field in dataclasses.fields(a)} - {"tensors", "running_loss", "observed"}:
        assert getattr(a, name) == getattr(b, name), name
    assert a.running_loss == b.running_loss or np.isnan([a.running_loss, b.running_loss]).all()


@pytest.fixture(scope="module")
def restored(tiny, trained):
    """A trainer that has gone on from the finished run."""
    trainer = Trainer(datasets.read(tiny.root), trained.config)
    before = mean_loss(trainer)
    trainer.restore(checkpoint.load(trained.folder))
    return trainer, before


def test_training_brings_the_images_closer(restored):
    trainer, before = restored
    assert mean_loss(trainer) < 0.4 * before


@pytest.mark.parametrize("body", [tiny_datasets.BRICK, tiny_datasets.BALL])
def test_training_recovers_how_the_objects_move(restored, tiny, body):
    trainer, _ = restored
    norm = trainer.normalization
    last = trainer.motion.tracks.poses(tiny_datasets.T_MAX)
    center = trainer.motion.tracks.centers[body]
    there = torch.from_numpy((tiny.center(body, tiny_datasets.T_MAX) - norm.origin) / norm.scale).float()
    travel = np.linalg.norm(tiny.center(body, 0.0) - tiny.center(body, tiny_datasets.T_MAX))
    for t in tiny_datasets.OBSERVED:
        with torch.no_grad():
            pose = trainer.motion.tracks.poses(t)
            back = last.rotmats[body].T @ (there - center - last.displacements[body])
            here = pose.rotmats[body] @ back + center + pose.displacements[body]
            turn = rotations.multiply(pose.quats[body], rotations.conjugate(last.quats[body])).numpy()
        error = np.linalg.norm(norm.points_to_world(here.numpy()) - tiny.center(body, t))
        assert error < 0.05 * travel
        difference = rotations.multiply(turn.astype(np.float64), rotations.conjugate(tiny.turn(body, t)))
        assert np.degrees(2 * np.arccos(min(1.0, abs(difference[0])))) < 8


@pytest.fixture(scope="module")
def unbroken(tiny, tmp_path_factory):
    """States of one run of 60 steps: after 9, after 30, at the end; as files, as a kill leaves them."""
    patch = pytest.MonkeyPatch()
    patch.setattr(tracks, "REBASE_EVERY", 25)
    trainer = make(tiny)
    folder, start = tmp_path_factory.mktemp("states"), len(trainer.gaussians)
    for k in (9, 30, 60):
        while trainer.iteration < k:
            trainer.step()
        (folder / str(k)).mkdir()
        checkpoint.save(folder / str(k), trainer.state())
    assert len(trainer.gaussians) != start  # a densify round was crossed
    yield folder, trainer
    patch.undo()


@pytest.mark.default_cases("30")
@pytest.mark.parametrize("broken_at", [9, 30])
def test_a_restored_trainer_continues_to_the_same_bits(tiny, unbroken, broken_at):
    folder, reference = unbroken
    trainer = make(tiny)
    trainer.restore(checkpoint.load(folder / str(broken_at)))
    entered = trainer.curriculum.entered
    while not trainer.done:
        trainer.step()
    assert_same_state(trainer.state(), reference.state())
    assert broken_at > 18 or trainer.curriculum.entered != entered  # a time entered after the break


def test_training_does_not_change_a_saved_state(tiny, unbroken):
    folder, _ = unbroken
    state = checkpoint.load(folder / "9")
    trainer = make(tiny)
    trainer.restore(state)
    for _ in range(5):
        trainer.step()
    untouched = checkpoint.load(folder / "9")
    assert_same_state(state, untouched)


@pytest.mark.parametrize("name", ["means", "sh", "translations", "background"])
def test_a_gradient_that_is_not_finite_stops_the_run_before_the_update(tiny, name):
    trainer = make(tiny)
    for _ in range(3):
        trainer.step()
    before = trainer.state()
    params = {**trainer.gaussians.params, **trainer.motion.params, **trainer.background.params}
    params[name].register_hook(lambda gradient: gradient * float("nan"))
    with pytest.raises(TrainingError, match=rf"step 3, view train/r_\d+: not finite: gradient of {name}"):
        trainer.step()
    for key, tensor in trainer.state().tensors.items():
        assert key == "generator" or torch.equal(tensor, before.tensors[key]), key


def test_a_parameter_that_is_not_finite_is_a_training_error(tiny):
    trainer = make(tiny)
    with torch.no_grad():
        trainer.gaussians.params["log_scales"][3] = float("nan")
    with pytest.raises(TrainingError, match=r"step 0, view train/r_\d+: not finite: log_scales"):
        trainer.step()


def test_times_enter_from_the_first_one_outwards_until_all_are_in(tiny):
    trainer = make(tiny)
    seen = [trainer.curriculum.entered]
    while not trainer.done:
        trainer.step()
        low, high = trainer.curriculum.entered
        assert low <= seen[-1][0] and high >= seen[-1][1]
        seen.append(trainer.curriculum.entered)
    assert seen[0][0] == seen[0][1] == trainer.first_time
    assert seen[-1] == (0, 5) and len(set(seen)) > 2


def test_shading_is_that_of_a_ball_until_all_times_have_entered_and_trained_from_nothing_then(tiny):
    trainer = make(tiny, "train.iterations=100", "densify.start=1000")
    centers, ids = trainer.motion.tracks.centers, trainer.gaussians.motion_ids
    bodies = (ids > 0) & (ids < len(centers))
    ways = trainer.gaussians.means.detach() - centers[ids.clamp(max=len(centers) - 1)]
    expected = torch.where(bodies[:, None], 0.3 * torch.nn.functional.normalize(ways, dim=1), 0.0)
    light = trainer.motion.light.detach().clone()
    while trainer.curriculum.entered == (trainer.first_time,) * 2:
        assert torch.allclose(trainer.gaussians.shading, expected, atol=1e-6)
        assert torch.equal(trainer.motion.light, light)
        trainer.step()
    for _ in range(trainer.iteration, trainer.config.curriculum.steps(100)[1]):
        assert torch.allclose(trainer.gaussians.shading, expected, atol=1e-6)
        trainer.step()
    assert trainer.curriculum.entered == (0, 5)
    assert not trainer.gaussians.shading.any()
    trainer.step()
    moved = trainer.gaussians.shading.abs().amax(1)[bodies]
    assert (moved > 0).float().mean() > 0.5 and moved.max() < 0.1


def test_objects_without_shading_and_fields_start_with_constant_colours(tiny):
    for override in ("train.shading=false", "train.representation='field'", "init.shading=0"):
        assert not make(tiny, override).gaussians.shading.any()


def test_background_seen_by_a_single_camera_keeps_its_position(tiny):
    trainer = make(tiny, "densify.start=1000")
    means = trainer.gaussians.params["means"]
    row = int(torch.nonzero(trainer.gaussians.motion_ids == 0)[0, 0])
    eye = trainer.distinct_cameras[0]
    with torch.no_grad():
        means[row] = torch.from_numpy(eye.center + 0.3 * eye.forward).float()
    before = means.detach().clone()
    for _ in range(2 * len(trainer.views)):
        trainer.step()
    moved = (trainer.gaussians.params["means"].detach() != before).any(1)
    assert not moved[row] and moved.sum() > 0.9 * len(moved)


def test_without_masks_everything_is_one_pinned_group(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path, masks=False)
    trainer = make(data)
    before = mean_loss(trainer)
    while not trainer.done:
        trainer.step()
    assert trainer.motion.tracks.groups == 1 and (trainer.gaussians.motion_ids == 0).all()
    assert mean_loss(trainer) < before


def test_transparent_images_are_trained_on_a_fixed_background(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path, alpha=True)
    trainer = make(data)
    before = mean_loss(trainer)
    while not trainer.done:
        trainer.step()
    corner = trainer.render(trainer.views[0].camera, 0.0).detach()[0, 0]
    torch.testing.assert_close(corner, torch.ones(3), atol=0.02, rtol=0)
    assert "background" not in {group["name"] for group in trainer.optimizer.param_groups}
    assert mean_loss(trainer) < 0.8 * before


def test_an_object_may_be_absent_at_the_first_times(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path, ball_from=0.4)
    trainer = make(data)
    assert trainer.places.measured.tolist() == [[True] * 6, [False] * 3 + [True] * 3]
    while not trainer.done:
        trainer.step()
    assert all(torch.isfinite(p).all() for p in trainer.gaussians.params.values())
    tracks = trainer.motion.tracks
    late = tracks.poses(0.75).displacements[2] - tracks.poses(0.45).displacements[2]
    expected = (data.center(2, 0.75) - data.center(2, 0.45)) / trainer.normalization.scale
    np.testing.assert_allclose(late.detach().numpy(), expected, atol=0.06)

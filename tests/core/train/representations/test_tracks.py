"""Tracks in training: start of knots, absent bodies, and motion while masks are missing."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.motion import rotations
from r5dgs_core.train.initialization import evidence, initialize, triangulation
from r5dgs_core.train.representations import tracks as tracks_representation
from r5dgs_core.train.trainer import Trainer
from tests.support import scenes, tiny_datasets

pytestmark = pytest.mark.heavy

TIMES = np.array([0.0, 0.1, 0.3, 0.4, 0.6, 0.9, 1.0])
VELOCITY, SPIN = np.array([0.8, -0.4, 0.2]), np.array([0.3, 0.1, 1.5])


def truth(t):
    """Displacement and rotation of steady motion."""
    return VELOCITY * t, rotations.rotvecs_to_quats(SPIN * t)


def make(measured, absent=None, first=3, path=None):
    """One body that starts at knot ``first``; its path is known from masks where ``measured``, straight elsewhere."""
    count = len(TIMES)
    tracks = initialize.FirstTracks(
        TIMES, np.zeros((2, 3)), np.zeros((2, count, 3)), np.array([1]), None, np.zeros(3), np.array([0.0, 0, 1])
    )
    centers = np.asarray(path if path is not None else [truth(t)[0] for t in TIMES])[None]
    places = triangulation.ObjectPositions(
        np.array([1]),
        centers,
        np.array([measured], bool),
        np.ones((1, count)),
        np.ones(1),
        np.ones((1, count)),
        np.array([measured], bool),
    )
    gone = np.zeros((1, count), bool) if absent is None else np.array([absent], bool)
    known = evidence.BodyEvidence(np.ones((1, count)), np.tile(np.eye(3), (1, count, 1, 1)), gone)
    start = SimpleNamespace(tracks=tracks, places=places, evidence=known, first_time=first)
    return tracks_representation.TracksRepresentation(start, config.Config())


def set_knots(motion, knots):
    for k in knots:
        shift, quat = truth(TIMES[k])
        with torch.no_grad():
            motion.tracks.params["translations"][1, k] = torch.from_numpy(shift).float()
            motion.tracks.base_quats[1, k] = torch.from_numpy(quat).float()


def grow(motion, low, high):
    """Enter all knots, as the curriculum does."""
    while high < len(TIMES) - 1 or low > 0:
        if low > 0:
            motion.enter(low - 1, +1, (low, high))
            low -= 1
        if high < len(TIMES) - 1:
            motion.enter(high + 1, -1, (low, high))
            high += 1


@pytest.mark.parametrize("measured", [[1] * 7, [0, 0, 1, 1, 1, 0, 0], [0] * 7])
def test_constant_motion_is_extrapolated_over_uneven_knots(measured):
    motion = make(measured)
    set_knots(motion, (3, 4))
    grow(motion, 3, 4)
    for k, t in enumerate(TIMES):
        shift, quat = truth(t)
        found = motion.tracks.poses(float(t))
        np.testing.assert_allclose(found.displacements[1].detach().numpy(), shift, atol=1e-5)
        assert rotations.angle_between(found.quats[1].detach().numpy().astype(np.float64), quat) < 1e-3, k


def test_a_body_that_returns_is_placed_by_its_masks_not_by_extrapolation():
    path = np.array([truth(t)[0] for t in TIMES])
    path[5:] += [0.0, 0.7, 0.0]  # pushed while it was hidden at knot 4
    motion = make([1, 1, 1, 1, 0, 1, 1], path=path)
    set_knots(motion, (2, 3))
    grow(motion, 2, 3)
    found = motion.tracks.params["translations"][1].detach().numpy()
    np.testing.assert_allclose(found - found[3], path - path[3], atol=1e-5)


@pytest.mark.parametrize("drift, kept", [(0.9, 1.0), (1.1, 0.0)])
def test_a_body_that_has_drifted_from_its_masks_returns_to_them(drift, kept):
    motion, radius = make([True] * 7), 1.0
    set_knots(motion, range(1, 6))
    offset, away = np.array([0.2, 0.1, -0.3]), np.array([0, 0, drift * tracks_representation.DRIFT * radius])
    with torch.no_grad():
        motion.tracks.params["translations"][1] += torch.from_numpy(offset).float()
        motion.tracks.params["translations"][1, 5] += torch.from_numpy(away).float()
    motion.enter(6, -1, (1, 5))
    found = motion.tracks.params["translations"][1, 6].detach().numpy()
    np.testing.assert_allclose(found, truth(TIMES[6])[0] + offset + kept * away, atol=1e-5)


def test_velocity_continues_without_masks_and_follows_masks_if_absent():
    wrong = np.tile([0.0, 0.0, 0.0], (7, 1))  # the masks' path stands still
    for absent, expected in (([0] * 7, truth(TIMES[6])[0]), ([0, 0, 0, 0, 0, 1, 1], truth(TIMES[4])[0])):
        motion = make([0, 0, 1, 1, 1, 0, 0], absent, path=wrong)
        set_knots(motion, (2, 3, 4))
        grow(motion, 2, 4)
        np.testing.assert_allclose(motion.tracks.params["translations"][1, 6].detach().numpy(), expected, atol=1e-5)


def test_absent_bodies_and_their_shadows_are_neither_drawn_nor_trained():
    motion = make([1] * 7, [1, 1, 0, 0, 0, 0, 0])
    params = {
        "means": torch.zeros(3, 3),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(3, 1),
        "log_scales": torch.zeros(3, 3),
        "opacity_logits": torch.zeros(3),
        "sh": torch.zeros(3, 1, 3),
        "sh_rest": torch.zeros(3, 0, 3),
        "shading": torch.zeros(3, 3),
    }
    gaussians = Gaussians(params, torch.arange(3))
    camera = scenes.orbit_camera(0.0)
    for t, expected in ((0.0, [0.5, 0, 0]), (0.12, [0.5, 0, 0]), (0.3, [0.5] * 3), (1.0, [0.5] * 3)):
        splats = motion.splats(gaussians, camera, t)
        np.testing.assert_allclose(splats.opacities.detach().numpy(), expected, atol=1e-6)
    splats = motion.splats(gaussians, camera, 0.0)
    splats.opacities.sum().backward()
    assert gaussians.params["opacity_logits"].grad.tolist() == [0.25, 0, 0]


def test_a_checkpoint_holds_the_times_at_which_bodies_are_absent():
    motion, gone = make([1] * 7, [1, 1, 0, 0, 0, 0, 0]), [True] * 2 + [False] * 5
    found = motion.observed_motion(motion.tensors(), np.array([0, 1]), np.ones((1, 7), bool), None, config.Config())
    assert [group.role for group in found.groups] == ["pinned", "body", "shadow"]
    assert found.groups[0].absent is None
    assert [group.absent.tolist() for group in found.groups[1:]] == [gone, gone]
    assert tracks_representation.ABSENT not in make([1] * 7).tensors()


def test_a_restored_run_continues_with_the_same_knots():
    motion, other = make([1] * 7), make([1] * 7)
    grow(motion, 3, 3)
    other.restore(motion.tensors())
    for iteration in (0, 4):
        one, two = (m.penalty(None, iteration, None) for m in (motion, other))
        assert float(one.detach()) == float(two.detach())


def erase(data, object_id, before):
    """Remove an object from the masks of the training images before a time; the images stay as they are."""
    for view in datasets.read(data.root).train:
        if view.t < before:
            mask = datasets.load_mask(view)
            images.write_png(view.mask_path, np.where(mask == object_id, 0, mask).astype(np.uint8))


def path_error(trainer, data, object_id, t):
    """Distance from where an object truly is at a time, seen from its last pose; world units."""
    tracks, row = trainer.motion.tracks, trainer.object_ids.tolist().index(object_id)
    places = [tracks.poses(float(u)).displacements[row].detach().numpy() for u in (t, tiny_datasets.T_MAX)]
    moved = trainer.normalization.scale * (places[0] - places[1])
    return np.linalg.norm(moved - (data.center(object_id, t) - data.center(object_id, tiny_datasets.T_MAX)))


def train(data, *overrides):
    trainer = Trainer(datasets.read(data.root), tiny_datasets.settings("train.iterations=300", *overrides))
    while not trainer.done:
        trainer.step()
    return trainer


@pytest.mark.slow
def test_an_object_with_late_masks_is_tracked_in_earlier_images(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path)
    erase(data, tiny_datasets.BALL, 0.4)
    trainer = train(data)
    assert not trainer.places.measured[1, :3].any() and not trainer.motion._absent.any()
    assert path_error(trainer, data, tiny_datasets.BALL, 0.3) < 0.06
    assert path_error(trainer, data, tiny_datasets.BALL, 0.0) < 0.2  # 0.9 away from where it is first marked


@pytest.mark.slow
def test_an_object_that_appears_late_is_as_opaque_as_one_that_is_always_present(tmp_path):
    data = tiny_datasets.make_dataset(tmp_path, ball_from=0.6)
    trainer = train(data)
    assert trainer.motion._absent[1].tolist() == [True] * 4 + [False] * 2
    late = [v for v in trainer.views if v.t > 0.5]
    with torch.no_grad():
        gaps = [np.abs(trainer.render(v.camera, v.t).numpy() - v.image / 255)[v.mask == 2].mean() for v in late]
    assert np.mean(gaps) < 0.06

"""Uncertain labels are decided by neighbours and motion; certain labels do not change."""

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.evaluation import object_table
from r5dgs_core.motion import rotations
from r5dgs_core.train import checkpoint, observed_motion, run
from r5dgs_core.train.identity import label_cleanup
from tests.support import scenes, tiny_datasets

pytestmark = pytest.mark.heavy

LEFT, RIGHT, WIRE = 1, 2, 3
PIXELS = 20.0  # of votes that a Gaussian has


def block(draw, low, high, count):
    return draw.uniform(low, high, (count, 3))


def scene(seed=0):
    """A floor, two blocks that touch at x = 0 and a wire of 40 Gaussians: points and true classes."""
    draw = np.random.default_rng(seed)
    wire = np.stack([np.linspace(2.0, 4.0, 40), np.zeros(40), np.full(40, 0.5)], axis=1)
    parts = [
        block(draw, [-5, -5, -0.02], [5, 5, 0], 1500),
        block(draw, [-1, 0, 0.1], [0, 1, 1], 300),
        block(draw, [0, 0, 0.1], [1, 1, 1], 300),
        wire + 0.003 * draw.normal(size=wire.shape),
    ]
    labels = np.repeat(np.arange(4), [len(part) for part in parts])
    return np.concatenate(parts), labels, np.full(len(labels), 0.8)


def votes_for(labels, share=0.98, rival=0):
    """Votes that give a share to each label and the rest to a rival class."""
    weights = np.zeros((len(labels), 4))
    weights[np.arange(len(labels)), rival] += PIXELS * (1 - share)
    weights[np.arange(len(labels)), labels] += PIXELS * share
    return weights


def plant(weights, labels, rows, wrong, share=0.52, pixels=PIXELS):
    """Make some Gaussians vote for a wrong class, barely."""
    weights, said = weights.copy(), labels.copy()
    weights[rows], said[rows] = 0.0, wrong
    weights[rows, wrong], weights[rows, labels[rows]] = pixels * share, pixels * (1 - share)
    return weights, said


def test_planted_wrong_labels_are_found_and_nothing_else_is_touched():
    points, truth, opacities = scene()
    inner = np.flatnonzero((truth == LEFT) & (np.abs(points[:, 0] + 0.5) < 0.3))[:20]
    floor = np.flatnonzero((truth == 0) & (points[:, 0] < -2))[:20]
    weights, said = plant(votes_for(truth), truth, inner, RIGHT, 0.502)
    weights, said = plant(weights, said, floor, LEFT)
    found, changes = label_cleanup.clean(weights, said, points, opacities)
    np.testing.assert_array_equal(found, truth)
    assert changes.neighbours + changes.outliers == 40 and changes.motion == 0 and changes.gaussians == len(truth)


def test_strong_votes_are_never_overruled():
    points, truth, opacities = scene()
    inner = np.flatnonzero(truth == LEFT)[:30]
    weights, said = plant(votes_for(truth), truth, inner, RIGHT, 0.8)
    companions, moving = truth, np.ones(4, bool)
    found, changes = label_cleanup.clean(weights, said, points, opacities, companions, moving)
    np.testing.assert_array_equal(found, said)
    assert changes == label_cleanup.LabelChanges(gaussians=len(truth))


def test_objects_that_touch_keep_their_border_and_thin_ones_survive():
    points, truth, opacities = scene()
    found, changes = label_cleanup.clean(votes_for(truth, 0.7), truth, points, opacities)
    np.testing.assert_array_equal(found, truth)
    assert changes == label_cleanup.LabelChanges(gaussians=len(truth))


def test_masks_that_sometimes_miss_an_object_do_not_shrink_it():
    points, truth, opacities = scene()
    weights = votes_for(truth, 0.65)
    edge = np.flatnonzero((truth == LEFT) & (points[:, 2] > 0.9) & (points[:, 0] < -0.3))
    weights[edge] = [PIXELS * 0.52, PIXELS * 0.48, 0, 0]  # with all masks the object would have most
    found, _ = label_cleanup.clean(weights, np.where(weights.any(1), weights.argmax(1), 0), points, opacities)
    np.testing.assert_array_equal(found[edge], LEFT)
    clean = votes_for(truth)
    clean[edge] = weights[edge]
    found, _ = label_cleanup.clean(clean, clean.argmax(1), points, opacities)
    np.testing.assert_array_equal(found[edge], 0)


def test_masks_that_contradict_each_other_change_nothing():
    points, truth, opacities = scene()
    weights = np.random.default_rng(1).dirichlet(np.full(4, 3.0), len(truth)) * PIXELS
    weights[np.arange(len(truth)), truth] += 0.2 * PIXELS
    found, changes = label_cleanup.clean(weights, truth, points, opacities, truth, np.ones(4, bool))
    np.testing.assert_array_equal(found, truth)
    assert changes == label_cleanup.LabelChanges(gaussians=len(truth))


def test_unseen_gaussians_take_the_surrounding_label():
    points, truth, opacities = scene()
    unseen = np.flatnonzero((truth == RIGHT) & (np.abs(points[:, 0] - 0.5) < 0.3))[::5]
    weights, said = votes_for(truth), truth.copy()
    weights[unseen], said[unseen] = 0.0, 0
    found, _ = label_cleanup.clean(weights, said, points, opacities)
    np.testing.assert_array_equal(found[unseen], RIGHT)


def test_small_distant_parts_change_their_label_and_large_ones_keep_it():
    points, truth, opacities = scene()
    draw = np.random.default_rng(3)
    for count, expected in ((8, 0), (120, LEFT)):
        far = block(draw, [-3, -3, 3], [-2.9, -2.9, 3.1], count)
        every, labels = np.concatenate([points, far]), np.append(truth, np.full(count, LEFT))
        weights = votes_for(labels)
        weights[-count:] = [0.45 * PIXELS, 0.55 * PIXELS, 0, 0]
        found, changes = label_cleanup.clean(weights, labels, every, np.full(len(labels), 0.8))
        np.testing.assert_array_equal(found[-count:], expected)
        np.testing.assert_array_equal(found[:-count], truth)
        assert changes.outliers == (count if expected == 0 else 0)
        weights[-count:] = [0.1 * PIXELS, 0.9 * PIXELS, 0, 0]  # well supported, so its position is no evidence
        found, _ = label_cleanup.clean(weights, labels, every, np.full(len(labels), 0.8))
        np.testing.assert_array_equal(found, labels)


def test_undecided_gaussians_take_the_label_that_their_motion_suggests():
    points, truth, opacities = scene()
    border = np.flatnonzero((truth == LEFT) & (points[:, 0] > -0.1))
    weights, said = plant(votes_for(truth), truth, border, RIGHT, 0.501)
    right = {}
    for moves in (False, True):
        moving = np.array([False, moves, moves, moves])
        found, changes = label_cleanup.clean(weights, said, points, opacities, truth, moving)
        right[moves] = (found[border] == LEFT).mean()
        assert (changes.motion > 0) == moves
    unknown, _ = label_cleanup.clean(weights, said, points, opacities)
    assert right[True] > 0.9 and right[False] < 0.8
    assert (unknown[border] == LEFT).mean() == right[False]  # in a static scene, motion is no evidence


def test_a_halo_that_rests_while_its_object_moves_is_background():
    points, truth, opacities = scene()
    halo = np.flatnonzero((truth == 0) & (np.abs(points[:, :2] - [-0.5, 0.5]) < 0.5).all(1))
    weights, said = plant(votes_for(truth), truth, halo, LEFT, 0.53)
    around = label_cleanup.clean(weights, said, points, opacities)[0][halo]
    moving = np.array([False, True, True, True])
    told, _ = label_cleanup.clean(weights, said, points, opacities, truth, moving)
    assert (told[halo] == 0).sum() > (around == 0).sum()


def test_an_outline_shared_evenly_with_the_background_belongs_to_the_background():
    points, truth, opacities = scene()
    rows = np.flatnonzero(truth == LEFT)[:25]
    weights, said = plant(votes_for(truth), truth, rows, 0, 0.501)
    found, _ = label_cleanup.clean(weights, said, points, opacities, truth, np.ones(4, bool))
    np.testing.assert_array_equal(found, said)


def test_faint_gaussians_are_never_added_to_an_object():
    points, truth, opacities = scene()
    rows = np.flatnonzero(truth == LEFT)[:25]
    weights, said = plant(votes_for(truth), truth, rows, 0, 0.501, pixels=1.0)
    opacities[rows] = 0.1
    found, _ = label_cleanup.clean(weights, said, points, opacities, truth, np.ones(4, bool))
    np.testing.assert_array_equal(found[rows], 0)
    opacities[rows] = 0.9
    found, _ = label_cleanup.clean(weights, said, points, opacities, truth, np.ones(4, bool))
    np.testing.assert_array_equal(found[rows], LEFT)


def test_the_numbers_of_the_objects_and_the_order_of_the_gaussians_do_not_matter():
    points, truth, opacities = scene()
    draw = np.random.default_rng(5)
    weights = votes_for(truth, 0.9) + PIXELS * draw.random((len(truth), 1)) * draw.dirichlet(
        np.full(4, 0.3), len(truth)
    )
    said, companions, moving = weights.argmax(1), truth, np.array([False, True, False, True])
    found, changes = label_cleanup.clean(weights, said, points, opacities, companions, moving)
    assert (found != said).sum() > 0
    name = np.array([0, 3, 1, 2])  # of each class; the background stays what it is
    renamed = np.empty_like(weights)
    renamed[:, name] = weights
    told = np.zeros(4, bool)
    told[name] = moving
    order = draw.permutation(len(truth))
    again, same = label_cleanup.clean(
        renamed[order], name[said][order], points[order], opacities[order], name[companions][order], told
    )
    np.testing.assert_array_equal(again, name[found][order])
    assert same == changes


def test_empty_and_tiny_inputs_do_not_change():
    for count in (0, 1, 2, 5):
        points = np.arange(3.0 * count).reshape(count, 3)
        weights = np.tile([0.0, 5.0, 0.0], (count, 1))
        found, changes = label_cleanup.clean(weights, np.ones(count, int), points, np.full(count, 0.5))
        assert found.tolist() == [1] * count and changes.gaussians == count
    same = np.zeros((30, 3))  # all in one place, and an object (2) that has no Gaussians
    found, _ = label_cleanup.clean(np.tile([0.0, 5.0, 0.0], (30, 1)), np.ones(30, int), same, np.full(30, 0.5))
    assert found.tolist() == [1] * 30
    alone = np.zeros((30, 2))
    alone[:, 0] = 5.0
    alone[3] = [2.6, 2.5]
    labels = np.zeros(30, int)
    labels[3] = 1  # its only Gaussian, and weak: the object is not emptied
    found, _ = label_cleanup.clean(alone, labels, np.random.default_rng(0).normal(size=(30, 3)), np.full(30, 0.5))
    np.testing.assert_array_equal(found, labels)


def test_companions_are_bodies_that_move_and_the_bind_state_is_at_the_last_knot():
    still, half = rotations.identity(3), rotations.rotvecs_to_quats(np.array([[0, 0, 0], [0, 0, 0.5], [0, 0, np.pi]]))
    nowhere, path = np.zeros((3, 3)), np.array([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]])
    seen = np.ones(3, bool)
    made = [
        observed_motion.GroupTrack(0, "pinned", np.zeros(3), still, nowhere, seen),
        observed_motion.GroupTrack(7, "body", np.array([1.0, 0, 0]), half, nowhere, seen),
        observed_motion.GroupTrack(9, "body", np.zeros(3), still, path, seen),
        observed_motion.GroupTrack(4, "body", np.zeros(3), still, nowhere, seen),
        observed_motion.GroupTrack(9, "shadow", np.zeros(3), still, path, seen, 2, np.eye(3)),
    ]
    ids = np.repeat(np.arange(5), 20)
    means = np.random.default_rng(0).normal(scale=0.3, size=(100, 3))
    points = label_cleanup.bind_positions(made, ids, means)
    np.testing.assert_allclose(points[ids == 0], means[ids == 0])
    np.testing.assert_allclose(points[ids == 1], [2, 0, 0] + means[ids == 1] * [-1, -1, 1], atol=1e-12)
    np.testing.assert_allclose(points[ids == 4], means[ids == 4] + [0.4, 0, 0])
    companions, moving = label_cleanup.find_companions(made, ids, points, np.array([0, 4, 7, 9]))
    assert companions.tolist() == np.repeat([0, 2, 3, 1, 0], 20).tolist()
    assert moving.tolist() == [False, False, True, True]


@pytest.mark.slow
def test_label_cleanup_reports_its_changes_and_can_be_disabled(tiny, tmp_path):
    steps = ("train.iterations=60", "identity.iterations=5")
    made, states = {}, {}
    for name, further in (("on", ()), ("off", ("identity.hygiene=false",))):
        made[name] = run.train(tiny.root, tmp_path / name, tiny_datasets.settings(*steps, *further))
        states[name] = checkpoint.load(made[name].folder).tensors
    assert label_cleanup.CHANGES not in states["off"]
    counts = label_cleanup.changes_of(states["on"])
    differ = int((states["on"]["labels"] != states["off"]["labels"]).sum())
    assert counts["gaussians"] == len(states["on"]["labels"])
    assert counts["neighbours"] + counts["motion"] + counts["outliers"] == differ > 0
    # The encodings follow the masks' edges by themselves: the maps of ids stay what they were, bit by bit.
    for name in ("identities", "classifier.weight", "classifier.bias", "gaussians.means"):
        assert torch.equal(states["on"][name], states["off"][name])
    baked = bake.bake(tiny_datasets.as_trained(made["on"]))
    assert baked.provenance["label_hygiene"] == counts
    assert "label_hygiene" not in bake.bake(tiny_datasets.as_trained(made["off"])).provenance


def test_the_table_of_objects_shows_changed_labels():
    plain = scenes.make_scene()
    counts = {"neighbours": 5, "motion": 3, "outliers": 2, "gaussians": 600}
    told = dataclasses.replace(plain, provenance={"label_hygiene": counts})
    caption = object_table.table(told, [], 0).caption
    assert "10 of 600 labels changed (neighbours 5, motion 3, outliers 2)" in caption
    assert object_table.to_json(told, [], 0)["label_hygiene"] == counts
    assert "labels changed" not in object_table.table(plain, [], 0).caption
    assert object_table.to_json(plain, [], 0)["label_hygiene"] is None

"""Rigidly moving parts among paths of points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r5dgs_core.motion import rigid_path, rotations
from r5dgs_core.train import motion_clusters

TIMES = np.linspace(0, 1, 9)


def body(rng, center, velocity, spin, count=80, size=0.3):
    """Paths of a ball of points that slides and turns. [count, S, 3]"""
    arms = rng.normal(size=(count, 3)) * size / 2
    quats = rotations.rotvecs_to_quats(np.outer(TIMES, spin))
    turned = rotations.rotate(quats[None], arms[:, None])
    return np.asarray(center) + turned + TIMES[None, :, None] * np.asarray(velocity)


def scene(rng, noise):
    """A box that slides past another one that turns, one that follows it, and points that go anywhere."""
    parts = [
        body(rng, [0, 0, 0], [1.5, 0, 0], [0, 0, 1.0], 120),
        body(rng, [0, 0.8, 0], [0, 0, 0.3], [0, 0, 2.5], 90),
        body(rng, [3, 0, 0], [1.5, 0, 0], [0, 0, 1.0], 60),
    ]
    stray = rng.uniform(-2, 4, (30, 1, 3)) + np.cumsum(rng.normal(size=(30, len(TIMES), 3)) * 0.2, 1)
    paths = np.concatenate([*parts, stray])
    truth = np.concatenate([np.repeat([0, 1, 2], [len(p) for p in parts]), np.full(len(stray), -1)])
    return paths + noise * rng.normal(size=paths.shape), truth


def agreement(found, truth):
    """Share of the points of each true part that the found part with most of them holds alone."""
    shares = []
    for k in range(truth.max() + 1):
        ids, counts = np.unique(found[(truth == k) & (found >= 0)], return_counts=True)
        best = ids[counts.argmax()] if len(ids) else -2
        shares.append((found[truth == k] == best).mean() * (truth[found == best] == k).mean())
    return shares


@pytest.mark.parametrize("seed", range(4))
def test_bodies_are_separated_by_motion_and_position(seed):
    rng = np.random.default_rng(seed)
    paths, truth = scene(rng, 0.01)
    order = rng.permutation(len(paths))
    labels = np.empty(len(paths), np.int64)
    labels[order] = motion_clusters.find(paths[order], np.ones(len(paths)), 0.03, 20, rng)
    assert labels.max() == 2 and min(agreement(labels, truth)) > 0.9
    assert (labels[truth < 0] >= 0).mean() < 0.2


def test_touching_bodies_with_equal_motion_are_one():
    rng = np.random.default_rng(0)
    motion = ([0.5, 0.2, 0], [0, 0, 1.0])
    left = body(rng, [0, 0, 0], *motion)
    quats = rotations.rotvecs_to_quats(np.outer(TIMES, motion[1]))
    arms = left[:, 4] - left[:, 4].mean(0) + [0.4, 0, 0]
    right = left.mean(0) + rotations.rotate(quats[None], rotations.rotate(rotations.conjugate(quats[4]), arms)[:, None])
    both = np.concatenate([left, right])
    labels = motion_clusters.find(both, np.ones(len(both)), 0.02, 20, rng)
    assert set(labels[labels >= 0]) == {0} and (labels == 0).mean() > 0.95


@pytest.mark.parametrize("count", [0, 1, 3, 19])
def test_too_few_points_form_no_part(count):
    rng = np.random.default_rng(0)
    paths = body(rng, [0, 0, 0], [1, 0, 0], [0, 0, 0], count)
    assert (motion_clusters.find(paths, np.ones(count), 0.02, 20, rng) == -1).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(4, 40))
def test_the_fit_is_the_motion_of_a_rigid_body(seed, count):
    rng = np.random.default_rng(seed)
    paths = body(rng, rng.normal(size=3), rng.normal(size=3), 2 * rng.normal(size=3), count)
    motion = rigid_path.fit(paths, rng.uniform(0.1, 1, count), 4)
    assert motion.residuals(paths, 4).max() < 1e-9
    np.testing.assert_allclose(np.linalg.det(motion.rotmats), 1, atol=1e-9)
    np.testing.assert_allclose(motion.rotmats[4], np.eye(3), atol=1e-9)


def test_without_moving_points_no_labels_are_extended():
    found = motion_clusters.attach(np.zeros((0, 5, 3)), np.zeros(0), 0.01, np.zeros(0, np.int64))
    assert found.shape == (0,)


def test_remaining_points_join_the_part_that_they_move_with():
    rng = np.random.default_rng(5)
    paths, truth = scene(rng, 0.01)
    asked = rng.random(len(paths)) < 0.6
    labels = np.full(len(paths), -1)
    labels[asked] = motion_clusters.find(paths[asked], np.ones(asked.sum()), 0.03, 20, rng)
    found = motion_clusters.attach(paths, np.ones(len(paths)), 0.03, labels)
    np.testing.assert_array_equal(found[labels >= 0], labels[labels >= 0])
    assert min(agreement(found, truth)) > 0.9
    none = np.full(len(paths), -1)
    np.testing.assert_array_equal(motion_clusters.attach(paths, np.ones(len(paths)), 0.03, none), none)

"""Clustering of tracklets: properties of the objects found in made-up overlaps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import sparse

from r5dgs_core.association import clustering
from r5dgs_core.association.tracklet_overlaps import TrackletOverlaps

LENGTH = 10  # images of a tracklet


def evidence(objects: list[int], views: list[int], overlap: float, ids: list[int] | None = None, noise: float = 0.0):
    """Tracklets in all images of their views, of 100 pixels; those of one object overlap by an IoU, others by less."""
    count = len(objects)
    places, index = np.unique(views, return_inverse=True)
    images = np.repeat(np.arange(len(places)) == index[:, None], LENGTH, axis=1)
    iou = np.where(np.equal.outer(objects, objects), overlap, noise * overlap)
    whole = 100.0 * LENGTH**2
    return TrackletOverlaps(
        common=sparse.csr_matrix(np.triu(2 * whole * iou / (1 + iou), 1).astype(np.float32)),
        own=np.full(count, 2 * whole * overlap / (1 + overlap)),
        visible=np.full(images.shape, 100.0 * LENGTH, np.float32),
        images=sparse.csr_matrix(images.astype(np.float32)),
        pixels=np.full(count, 100.0),
        views=np.array(views, int),
        ids=np.array(ids if ids is not None else [7] * count, int),
    )


@pytest.mark.parametrize("overlap", [0.9, 0.5, 0.2, 0.08])
def test_tracklets_join_by_the_usual_overlap_not_by_a_fixed_one(overlap):
    objects, views = [0, 1, 2, 0, 1, 2, 2, 0, 1], [0, 0, 0, 1, 1, 1, 2, 2, 2]
    found = clustering.cluster(evidence(objects, views, overlap, noise=0.15))
    pairs = {(o, f) for o, f in zip(objects, found.tolist(), strict=True)}
    assert len(pairs) == len(set(objects)) == len(set(found.tolist()))


def test_tracklets_that_appear_together_stay_separate_however_similar():
    found = clustering.cluster(evidence([0, 0], [0, 0], 0.9))
    assert found[0] != found[1]


def test_an_object_missing_in_one_view_joins_no_other():
    objects, views = [0, 1, 2, 0, 1, 3, 0, 1], [0, 0, 0, 1, 1, 1, 2, 2]
    found = clustering.cluster(evidence(objects, views, 0.4, noise=0.1))
    assert len({(o, f) for o, f in zip(objects, found.tolist(), strict=True)}) == 4 == len(set(found.tolist()))


def test_shared_ids_decide_if_geometry_does_not():
    objects, views = [0, 1, 2, 3] * 4, np.repeat([0, 1, 2, 3], 4).tolist()
    ids = [o + 1 for o in objects]
    made = evidence(objects, views, 0.3, ids, noise=0.3)
    made.common[0, 4:] = made.common[1, 4]  # geometry does not distinguish the objects of this tracklet
    found = clustering.cluster(made)
    assert found[0] == found[4]


def test_no_tracklets_are_no_objects():
    assert clustering.cluster(evidence([], [], 0.5)).tolist() == []


def test_medians_of_groups_are_the_values_at_half_their_weight():
    rng = np.random.default_rng(0)
    values, weights = rng.choice(rng.random(40), 200), rng.integers(1, 6, 200).astype(float)
    groups = np.concatenate([np.arange(9), rng.integers(0, 9, 191)])
    found = clustering._medians(values, weights, groups)
    for group, median in enumerate(found):
        here = groups == group
        half = 0.5 * weights[here].sum()
        assert median in values[here]
        assert weights[here & (values < median)].sum() < half <= weights[here & (values <= median)].sum()


def test_medians_of_all_pairs_of_views_are_taken_at_once(monkeypatch):
    sorts, lexsort = [], np.lexsort
    monkeypatch.setattr(np, "lexsort", lambda keys: sorts.append(len(keys[0])) or lexsort(keys))
    views = 30
    many = evidence([0, 1] * views, np.repeat(np.arange(views), 2).tolist(), 0.5)
    assert len(np.unique(clustering.cluster(many))) == 2
    assert max(sorts) == views * (views - 1) and len(sorts) < 10


def random_evidence(seed: int, objects: int = 6, views: int = 4, parts: int = 3) -> TrackletOverlaps:
    """Tracklets of a few images; most of different objects share no Gaussians."""
    rng = np.random.default_rng(seed)
    of, at = (a.ravel() for a in np.meshgrid(np.arange(objects), np.repeat(np.arange(views), parts)))
    made = evidence(of.tolist(), at.tolist(), 0.5, noise=0.3)
    share = np.where(np.equal.outer(of, of), 0.9, 0.2) * np.not_equal.outer(at, at)
    images = np.zeros(made.images.shape, np.float32)
    for k, view in enumerate(at):  # the parts of a view share its images
        images[k, LENGTH * view + k // objects % parts : LENGTH * (view + 1) : parts] = 1
    return dataclasses.replace(
        made,
        common=made.common.multiply(rng.uniform(0.02, 0.2, share.shape) * (rng.random(share.shape) < share)).tocsr(),
        visible=(made.visible * rng.uniform(0.5, 1.0, made.visible.shape)).astype(np.float32),
        images=sparse.csr_matrix(images),
    )


def joined_one_by_one(sums: clustering._Sums) -> np.ndarray:
    """Join the best pair of all, again and again, with sums over all pairs of tracklets. [T]"""
    made, count = sums.evidence, len(sums.evidence.views)
    rows, columns = (a.ravel() for a in np.meshgrid(np.arange(count), np.arange(count)))
    common = made.common_of(rows, columns)
    table = sums.of_tracklets(rows, columns, common, made.seen(rows, columns) - common).reshape(3, count, count)
    labels = np.arange(count)
    while True:
        member = np.equal.outer(np.unique(labels), labels).astype(float)
        lengths = member @ made.lengths
        common, expected, together = member @ table @ member.T
        apart = together <= clustering.SIDE_BY_SIDE * np.minimum(lengths, lengths[:, None])
        affinity = np.where(apart, common / expected, 0.0)
        np.fill_diagonal(affinity, 0.0)
        one, other = np.unravel_index(affinity.argmax(), affinity.shape)
        if affinity[one, other] < clustering.SAME:
            return labels
        names = np.unique(labels)
        labels[labels == names[max(one, other)]] = names[min(one, other)]


@pytest.mark.parametrize("seed", range(8))
def test_joining_in_rounds_equals_joining_the_best_pair_again_and_again(seed):
    made = random_evidence(seed)
    made = dataclasses.replace(made, ids=np.random.default_rng(seed).integers(0, 3, len(made.views)))
    usual = np.random.default_rng(seed).uniform(0.05, 0.2, (4, 4))
    sums = clustering._Sums(made, usual + usual.T, np.array([[0.9, 1.2], [0.8, 1.1]]))
    found = clustering._join(sums)
    np.testing.assert_array_equal(found, joined_one_by_one(sums))
    assert 1 < len(np.unique(found)) < len(found) / 2


def test_hints_count_the_shorter_lengths_of_tracklets_that_never_appear_together():
    made = random_evidence(3)
    made = dataclasses.replace(made, ids=np.random.default_rng(0).integers(0, 3, len(made.views)))
    apart = np.triu((made.images @ made.images.T).toarray() == 0, 1)
    least = np.minimum(made.lengths, made.lengths[:, None]) * apart
    equal, within = made.ids == made.ids[:, None], made.views == made.views[:, None]
    for (everything, alike), scope in zip(clustering._least_lengths(made), (~within, within), strict=True):
        assert everything == (least * scope).sum() > alike == (least * (scope & equal)).sum() > 0

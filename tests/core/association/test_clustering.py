"""Clustering of runs: laws on tables of evidence written by hand."""

from __future__ import annotations

import numpy as np
import pytest

from r5dgs_core.association import clustering


def evidence(objects: list[int], views: list[int], overlap: float, ids: list[int] | None = None, noise: float = 0.0):
    """Runs of 10 images each of 100 pixels; runs of one object overlap by an IoU, others by a share of it."""
    objects, views = np.array(objects), np.array(views)
    iou = np.where(objects[:, None] == objects[None], overlap, noise * overlap)
    seen = np.full(iou.shape, 100.0 * 100)
    return clustering.TrackletOverlaps(
        common=2 * seen * iou / (1 + iou),
        seen=seen,
        together=np.where(views[:, None] == views[None], 10.0, 0.0),
        lengths=np.full(len(objects), 10),
        pixels=np.full(len(objects), 100.0),
        views=views,
        ids=np.array(ids if ids is not None else [7] * len(objects)),
    )


@pytest.mark.parametrize("overlap", [0.9, 0.5, 0.2, 0.08])
def test_runs_join_by_the_usual_overlap_not_by_a_fixed_one(overlap):
    objects, views = [0, 1, 2, 0, 1, 2, 2, 0, 1], [0, 0, 0, 1, 1, 1, 2, 2, 2]
    found = clustering.cluster(evidence(objects, views, overlap, noise=0.15))
    pairs = {(o, f) for o, f in zip(objects, found.tolist(), strict=True)}
    assert len(pairs) == len(set(objects)) == len(set(found.tolist()))


def test_runs_that_appear_together_stay_separate_however_similar():
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
    made.common[0, 4:] = made.common[4:, 0] = made.common[1, 4]  # of this run geometry knows nothing
    found = clustering.cluster(made)
    assert found[0] == found[4]


def test_no_runs_are_no_objects():
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
    assert max(sorts) > views**2 and len(sorts) < 5

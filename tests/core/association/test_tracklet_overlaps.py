"""Overlaps of tracklets against sums over all pairs of segments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from r5dgs_core.association import segment_stack, tracklet_overlaps


def stack(rng: np.random.Generator, views: int = 3, times: int = 4, objects: int = 4) -> segment_stack.SegmentStack:
    """Images of some objects each, whose pixels show random Gaussians."""
    images = []
    for view in range(views):
        for t in range(times):
            mask = rng.choice(rng.permutation(objects + 1)[:objects], 200)
            shown, weights = rng.integers(0, 60, (200, 2)) + 40 * mask[:, None], rng.random((200, 2))
            images.append(segment_stack.from_pixels(mask, shown, weights, 400, view=view, time=t))
    return segment_stack.stack(images)


def test_overlaps_are_sums_over_the_segments_of_tracklets():
    rng = np.random.default_rng(0)
    segments = stack(rng)
    count = 3 * 4  # a tracklet of each id in each view
    runs = np.where(segments.ids > 0, segments.views[segments.images] * 4 + segments.ids - 1, -1)
    found = tracklet_overlaps.gather(segments, runs)
    member = np.equal.outer(np.arange(count), runs).astype(float)
    shared = segments.shared.toarray().astype(float)
    common = member @ shared @ shared.T @ member.T
    seen = member @ shared @ segments.seen.toarray().T[:, segments.images] @ member.T
    rows, columns = found.pairs
    assert (rows < columns).all()
    assert len(rows) == np.count_nonzero(np.triu(common, 1)) < count * (count - 1) / 2
    np.testing.assert_allclose(found.common.data, common[rows, columns], rtol=1e-5)
    np.testing.assert_allclose(found.common_of(columns, rows), common[rows, columns], rtol=1e-5)
    assert found.common_of(*np.nonzero(np.triu(common == 0, 1))).tolist() == [0.0] * np.sum(np.triu(common == 0, 1))
    np.testing.assert_allclose(found.own, np.diag(common), rtol=1e-5)
    np.testing.assert_allclose(found.seen(rows, columns), (seen + seen.T)[rows, columns], rtol=1e-5)
    images = np.array([[np.any(segments.images[runs == run] == k) for k in range(12)] for run in range(count)])
    together = images * 1.0 @ images.T
    np.testing.assert_array_equal(found.together(rows, columns), together[rows, columns])
    ious = np.where(together > 0, 0.0, common / (seen + seen.T - common))
    np.testing.assert_allclose(found.ious, ious[rows, columns], rtol=1e-5)
    np.testing.assert_array_equal(found.lengths, images.sum(axis=1))


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_sums_do_not_depend_on_the_chunks(chunk, monkeypatch):
    rng = np.random.default_rng(1)
    table = rng.random((20, 9)).astype(np.float32)
    images = sparse.random_array((20, 9), density=0.5, rng=rng).tolil()
    images[:, 0] = 1.0
    rows, columns = rng.integers(0, 20, (2, 50))
    monkeypatch.setattr(tracklet_overlaps, "CHUNK", chunk)
    found = tracklet_overlaps.summed(table, sparse.csr_matrix(images), rows, columns)
    np.testing.assert_allclose(found, (table @ images.toarray().T)[rows, columns], rtol=1e-6)
    assert tracklet_overlaps.summed(table, sparse.csr_matrix(images), rows[:0], columns[:0]).tolist() == []


def test_batches_hold_as_many_items_as_fit_and_at_least_one():
    found = [(some.start, some.stop) for some in tracklet_overlaps.batches(np.array([3, 4, 5, 20, 1, 9, 2]), 10)]
    assert found == [(0, 2), (2, 3), (3, 4), (4, 6), (6, 7)]

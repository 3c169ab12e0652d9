"""Clustering of tracklets into objects: greedy agglomeration, best pairs first, except pairs seen side by side.

The overlap of two views of one object depends on the accuracy of the geometry and on the commonly visible part, so a
fixed threshold fails. The usual IoU between two views is measured first, from tracklets that are mutual best matches;
all thresholds are relative to it. Incoming ids are weighted by the frequency at which tracklets of one object share an
id, compared with other tracklets.

Notation: T tracklets, I images, V views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from . import segment_stack

SAME = 0.3  # minimum affinity to join two groups, relative to the usual IoU
SIDE_BY_SIDE = 0.08  # maximum share of the shorter group's images in which both may appear separately
PRIOR = 5.0  # weight of the usual IoU over all views in the estimate for two views, in tracklet pairs
PART = 0.6  # minimum share of a part inside a larger group, relative to the usual share of a group in itself
HINT = 4.0  # largest factor on the affinity for equal ids, and largest divisor for different ids
THIN = 0.1  # share of the smaller tracklet's pixels below which common evidence is weak


@dataclass(frozen=True)
class TrackletOverlaps:
    """Overlap of tracklets, summed over the pairs of their images.

    Attributes:
        common: Weight of Gaussians in both tracklets. [T, T]
        seen: Weight of the row's tracklet that is visible in the images of the column's tracklet. [T, T]
        together: Number of images that show both. [T, T]
        lengths: Number of images of each tracklet. [T]
        pixels: Mean segment size of each tracklet. [T]
        views: View of each tracklet. [T]
        ids: Incoming id of each tracklet. [T]
    """

    common: np.ndarray
    seen: np.ndarray
    together: np.ndarray
    lengths: np.ndarray
    pixels: np.ndarray
    views: np.ndarray
    ids: np.ndarray

    @property
    def union(self) -> np.ndarray:
        """Weight in either tracklet that is visible in the other's images. [T, T]"""
        return self.seen + self.seen.T - self.common


def gather(stack: segment_stack.SegmentStack, runs: np.ndarray) -> TrackletOverlaps:
    """Sum the overlaps of segments over their tracklets."""
    rows = np.flatnonzero(runs >= 0)
    count = int(runs.max(initial=-1)) + 1
    member = sparse.csr_matrix((np.ones(len(rows), np.float32), (runs[rows], rows)), (count, len(runs)))
    shared = member @ stack.shared
    images = sparse.csr_matrix(
        (np.ones(len(rows), np.float32), (runs[rows], stack.images[rows])), (count, len(stack.views))
    )
    lengths = np.bincount(runs[rows], minlength=count)
    first = rows[np.unique(runs[rows], return_index=True)[1]]
    return TrackletOverlaps(
        common=sparse.csr_matrix(shared @ shared.T).toarray().astype(float),
        seen=sparse.csr_matrix(shared @ stack.seen.T @ images.T).toarray().astype(float),
        together=(images @ images.T).toarray(),
        lengths=lengths,
        pixels=np.bincount(runs[rows], stack.pixels[rows], minlength=count) / np.maximum(lengths, 1),
        views=stack.views[stack.images[first]],
        ids=stack.ids[first],
    )


def cluster(evidence: TrackletOverlaps) -> np.ndarray:
    """Join tracklets to objects.

    Returns:
        Object of each tracklet, numbered by descending total number of pixels. [T]
    """
    count = len(evidence.lengths)
    if not count:
        return np.zeros(0, int)
    mutual = _mutual(evidence)
    level = _usual(evidence, mutual)
    pairs = np.outer(evidence.lengths, evidence.lengths)
    thin = THIN * np.minimum(evidence.pixels[:, None], evidence.pixels[None]) * pairs
    labels = _join(evidence.common * _hints(evidence, mutual), level * (evidence.union + thin), evidence)
    labels = _absorb(evidence, labels)
    size = np.bincount(labels, evidence.lengths * evidence.pixels, minlength=count)
    rank = np.empty(count, int)
    rank[np.argsort(-size, kind="stable")] = np.arange(count)
    return rank[labels]


def _mutual(evidence: TrackletOverlaps) -> np.ndarray:
    """Mask of tracklet pairs that are mutual best matches in each other's view. [T, T] bool"""
    ious = np.where(evidence.together > 0, 0.0, evidence.common / np.maximum(evidence.union, 1e-9))
    views, at = np.unique(evidence.views, return_inverse=True)
    best = np.stack([ious[:, at == v].max(axis=1) for v in range(len(views))], axis=1)  # of each tracklet in each view
    return (ious > 0) & (ious >= best[:, at]) & (ious >= best[:, at].T)


def _usual(evidence: TrackletOverlaps, mutual: np.ndarray) -> np.ndarray:
    """Usual IoU of tracklets of one object between the views of any two tracklets. [T, T]"""
    views, at = np.unique(evidence.views, return_inverse=True)
    rows, columns = np.nonzero(mutual)
    if not len(rows):
        return np.ones_like(evidence.common)
    weight = np.minimum(evidence.lengths[rows], evidence.lengths[columns]).astype(float)
    found = evidence.common[rows, columns] / np.maximum(evidence.union[rows, columns], 1e-9)
    everywhere = _median(found, weight)
    table = np.full((len(views), len(views)), everywhere)
    pair, members = np.unique(at[rows] * len(views) + at[columns], return_inverse=True)
    counts = np.bincount(members)
    table.flat[pair] = (_medians(found, weight, members) * counts + everywhere * PRIOR) / (counts + PRIOR)
    return table[at[:, None], at[None, :]]


def _hints(evidence: TrackletOverlaps, mutual: np.ndarray) -> np.ndarray:
    """Factors on the affinity for equal and different ids, estimated within a view and between views. [T, T]"""
    equal = evidence.ids[:, None] == evidence.ids[None]
    within = evidence.views[:, None] == evidence.views[None]
    weight = np.minimum(evidence.lengths[:, None], evidence.lengths[None]) * (evidence.together == 0)
    factors = np.ones_like(evidence.common)
    for scope in (within, ~within):
        likely = float((weight * (scope & mutual)).sum())
        if not likely:
            continue
        trust = float((weight * (scope & mutual & equal)).sum()) / likely
        chance = float((weight * (scope & equal)).sum()) / float((weight * scope).sum())
        if trust <= chance:
            continue
        alike, unlike = (np.sqrt((a + 0.05) / (b + 0.05)) for a, b in ((trust, chance), (1 - trust, 1 - chance)))
        factors[scope & equal] = min(alike, HINT)
        factors[scope & ~equal] = max(unlike, 1 / HINT)
    return factors


def _join(common: np.ndarray, expected: np.ndarray, evidence: TrackletOverlaps) -> np.ndarray:
    """Join the best pair of groups until none is good enough; groups seen side by side stay apart. [T]"""
    count = len(common)
    common, expected, together = common.copy(), expected.copy(), evidence.together.copy()
    lengths = evidence.lengths.astype(float)
    labels, alive = np.arange(count), np.ones(count, bool)

    def affinity(row: int) -> np.ndarray:
        allowed = alive & (together[row] <= SIDE_BY_SIDE * np.minimum(lengths[row], lengths))
        allowed[row] = False
        return np.where(allowed, common[row] / np.maximum(expected[row], 1e-9), -1.0)

    table = np.stack([affinity(row) for row in range(count)])
    best = table.argmax(axis=1)
    value = table[np.arange(count), best]
    while True:
        a = int(value.argmax())
        if value[a] < SAME:
            return labels
        b = int(best[a])
        for matrix in (common, expected, together):
            matrix[a] += matrix[b]
            matrix[:, a] += matrix[:, b]
        lengths[a] += lengths[b]
        alive[b], labels[labels == b] = False, a
        value[b] = -1.0
        table[a] = affinity(a)
        table[:, a], table[b], table[:, b] = table[a], -1.0, -1.0
        stale = np.flatnonzero(alive & ((best == a) | (best == b) | (table[:, a] > value)))
        for row in {a, *stale.tolist()}:
            best[row] = table[row].argmax()
            value[row] = table[row, best[row]]


def _absorb(evidence: TrackletOverlaps, labels: np.ndarray) -> np.ndarray:
    """Join groups to a larger group that contains them if fewer than half of its images show both.

    This undoes splits by the tracker. Two objects that a tracker sometimes merges behave the opposite way: they are
    mostly seen apart.
    """
    groups, at = np.unique(labels, return_inverse=True)
    member = sparse.csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))))
    common, seen, together = (member @ m @ member.T for m in (evidence.common, evidence.seen, evidence.together))
    lengths = np.bincount(at, evidence.lengths)
    inside = common / np.maximum(seen, 1e-9)
    usual = _median(np.diag(inside), lengths)
    images = lengths.astype(float)
    target = np.arange(len(groups))
    for part in np.argsort(images, kind="stable"):
        whole = np.where((images > 2 * images[part]) & (target == np.arange(len(groups))), inside[part], 0.0)
        whole[part] = 0.0
        best = int(whole.argmax())
        if whole[best] >= PART * usual and together[part, best] < 0.5 * images[best]:
            target[part] = best
    while (target[target] != target).any():
        target = target[target]
    return groups[target[at]]


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    return float(_medians(values, weights, np.zeros(len(values), int))[0])


def _medians(values: np.ndarray, weights: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the weighted median of each group. [P], [P], [P] int from 0 to K - 1 -> [K]"""
    order = np.lexsort((values, groups))
    below, last = np.cumsum(weights[order]), np.cumsum(np.bincount(groups)) - 1
    before = np.concatenate([[0.0], below[last[:-1]]])
    return values[order[np.searchsorted(below, 0.5 * (before + below[last]))]]

"""Clustering of tracklets into objects: agglomeration, best pairs first, except pairs seen side by side.

The overlap of two views of one object depends on the accuracy of the geometry and on the commonly visible part, so a
fixed threshold fails. The usual IoU between two views is measured first, from tracklets that are mutual best matches;
all thresholds are relative to it. Incoming ids are weighted by the frequency at which tracklets of one object share an
id, compared with other tracklets.

Notation: T tracklets, P pairs of tracklets that share Gaussians, V views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from . import tracklet_overlaps
from .tracklet_overlaps import TrackletOverlaps

SAME = 0.3  # minimum affinity to join two groups, relative to the usual IoU
SIDE_BY_SIDE = 0.08  # maximum share of the shorter group's images in which both may appear separately
PRIOR = 5.0  # weight of the usual IoU over all views in the estimate for two views, in tracklet pairs
PART = 0.6  # minimum share of a part inside a larger group, relative to the usual share of a group in itself
HINT = 4.0  # largest factor on the affinity for equal ids, and largest divisor for different ids
THIN = 0.1  # share of the smaller tracklet's pixels below which common evidence is weak
ROWS = 1024  # tracklets that are compared with all others at once


def cluster(evidence: TrackletOverlaps) -> np.ndarray:
    """Join tracklets to objects.

    Returns:
        Object of each tracklet, numbered by descending total number of pixels. [T]
    """
    count = len(evidence.views)
    if not count:
        return np.zeros(0, int)
    mutual = _mutual(evidence)
    labels = _join(evidence, _usual(evidence, mutual), _hints(evidence, mutual))
    labels = _absorb(evidence, labels)
    size = np.bincount(labels, evidence.lengths * evidence.pixels, minlength=count)
    rank = np.empty(count, int)
    rank[np.argsort(-size, kind="stable")] = np.arange(count)
    return rank[labels]


def _mutual(evidence: TrackletOverlaps) -> np.ndarray:
    """Mask of tracklet pairs that are mutual best matches in each other's view. [P] bool"""
    ious = np.where(evidence.together > 0, 0.0, evidence.common / np.maximum(evidence.union, 1e-9))
    at = evidence.view_index
    best = np.zeros((len(at), at.max() + 1))  # of each tracklet in each view
    sides = [(evidence.rows, at[evidence.columns]), (evidence.columns, at[evidence.rows])]
    for side in sides:
        np.maximum.at(best, side, ious)
    return (ious > 0) & (ious >= best[sides[0]]) & (ious >= best[sides[1]])


def _usual(evidence: TrackletOverlaps, mutual: np.ndarray) -> np.ndarray:
    """Usual IoU of tracklets of one object between two views, see `TrackletOverlaps.view_index`. [V, V]"""
    at = evidence.view_index
    views = int(at.max()) + 1
    rows, columns = evidence.rows[mutual], evidence.columns[mutual]
    if not len(rows):
        return np.ones((views, views))
    weight = np.minimum(evidence.lengths[rows], evidence.lengths[columns]).astype(float)
    found = evidence.common[mutual] / np.maximum(evidence.union[mutual], 1e-9)
    everywhere = _median(found, weight)
    table = np.full((views, views), everywhere)
    low, high = np.minimum(at[rows], at[columns]), np.maximum(at[rows], at[columns])
    pair, members = np.unique(low * views + high, return_inverse=True)
    counts = np.bincount(members)
    usual = (_medians(found, weight, members) * counts + everywhere * PRIOR) / (counts + PRIOR)
    table.flat[pair] = table.T.flat[pair] = usual
    return table


def _hints(evidence: TrackletOverlaps, mutual: np.ndarray) -> np.ndarray:
    """Factors on the affinity for equal and different ids, estimated within a view and between views. [P]"""
    rows, columns = evidence.rows, evidence.columns
    equal = evidence.ids[rows] == evidence.ids[columns]
    within = evidence.views[rows] == evidence.views[columns]
    weight = np.minimum(evidence.lengths[rows], evidence.lengths[columns]) * mutual
    factors = np.ones(len(rows))
    for scope, (everything, alike) in zip((within, ~within), _least_lengths(evidence), strict=True):
        likely = float((weight * scope).sum())
        if not likely:
            continue
        trust, chance = float((weight * (scope & equal)).sum()) / likely, alike / everything
        if trust <= chance:
            continue
        more, less = (np.sqrt((a + 0.05) / (b + 0.05)) for a, b in ((trust, chance), (1 - trust, 1 - chance)))
        factors[scope & equal] = min(more, HINT)
        factors[scope & ~equal] = max(less, 1 / HINT)
    return factors


def _least_lengths(evidence: TrackletOverlaps) -> tuple[tuple[float, float], tuple[float, float]]:
    """Sum the shorter length over all pairs of tracklets that never appear together.

    Returns:
        Sums over the pairs of one view, all and those with equal ids, and the same over pairs of different views.
    """
    lengths, views, ids = evidence.lengths, evidence.views, evidence.ids
    within, alike = _least_sum(lengths, [views]), _least_sum(lengths, [views, ids])
    between = _least_sum(lengths, []) - within, _least_sum(lengths, [ids]) - alike
    for start in range(0, len(views), ROWS):  # in different views, no tracklets appear together
        together = sparse.coo_matrix(evidence.images[start : start + ROWS] @ evidence.images.T)
        rows, columns = together.row + start, together.col
        least = np.minimum(lengths[rows], lengths[columns]) * (rows < columns)
        within -= float(least.sum())
        alike -= float(least[ids[rows] == ids[columns]].sum())
    return (within, alike), between


def _least_sum(lengths: np.ndarray, keys: list[np.ndarray]) -> float:
    """Sum the shorter length over all pairs of tracklets with equal keys."""
    order = np.lexsort([lengths, *keys])
    new = np.zeros(len(order), bool)
    for key in keys:
        new[1:] |= np.diff(key[order]) != 0
    group = np.cumsum(new)
    longer = np.cumsum(np.bincount(group))[group] - 1 - np.arange(len(order))
    return float((lengths[order] * longer).sum())


@dataclass(frozen=True)
class _Links:
    """Pairs of groups that share Gaussians.

    Attributes:
        low: First group of each pair, less than the second. [P]
        high: Second group of each pair. [P]
        sums: Sums over the tracklets of both groups: common weight with the hints of the ids, weight that they would
            have in common if they were one object, and number of images that show both. [3, P]
    """

    low: np.ndarray
    high: np.ndarray
    sums: np.ndarray

    def best(self, lengths: np.ndarray) -> np.ndarray:
        """Indices of the pairs to join: neither group has a better partner. Groups have at most one pair.

        Args:
            lengths: Number of images of each group. [T]
        """
        common, expected, together = self.sums
        affinity = common / np.maximum(expected, 1e-9)
        apart = together <= SIDE_BY_SIDE * np.minimum(lengths[self.low], lengths[self.high])
        good = np.flatnonzero(apart & (affinity >= SAME))
        most, first = np.zeros(len(lengths)), np.full(len(lengths), len(affinity))
        for side in (self.low, self.high):
            np.maximum.at(most, side[good], affinity[good])
        good = good[affinity[good] == np.maximum(most[self.low[good]], most[self.high[good]])]
        for side in (self.low, self.high):
            np.minimum.at(first, side[good], good)  # of equal pairs, the first one
        return good[(first[self.low[good]] == good) & (first[self.high[good]] == good)]

    def join(self, pairs: np.ndarray, unlinked: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> _Links:
        """Join the groups of pairs; the low group keeps its number.

        Args:
            pairs: Indices of pairs without a common group.
            unlinked: Returns the sums of groups that share no Gaussians, see `_UnlinkedSums`. [M], [M] -> [3, M]
        """
        count = int(self.high.max()) + 1
        partner, target = np.full(count, -1), np.arange(count)
        kept, gone = self.low[pairs], self.high[pairs]
        partner[kept], partner[gone], target[gone] = gone, kept, kept
        rest = np.flatnonzero((partner[self.low] < 0) & (partner[self.high] < 0))
        ends = target[self.low], target[self.high]
        changed = np.flatnonzero(((partner[self.low] >= 0) | (partner[self.high] >= 0)) & (ends[0] != ends[1]))
        low, high = (f(ends[0][changed], ends[1][changed]) for f in (np.minimum, np.maximum))
        new, at = np.unique(low * count + high, return_inverse=True)
        low, high = np.divmod(new, count)
        # Parts of the new pairs that are not linked share no Gaussians, but raise the weight that is expected.
        parts = (1 + (partner[low] >= 0)) * (1 + (partner[high] >= 0))
        lacking = np.bincount(at, minlength=len(new)) < parts
        partial, linked = np.flatnonzero(lacking), changed[lacking[at]]
        one, other = low[partial], high[partial]
        one = np.stack([one, one, partner[one], partner[one]])
        other = np.stack([other, partner[other], other, partner[other]])
        key = np.minimum(one, other) * count + np.maximum(one, other)
        lacks = (one >= 0) & (other >= 0) & ~np.isin(key, self.low[linked] * count + self.high[linked])
        at = np.concatenate([at, partial[np.nonzero(lacks)[1]]])
        added = np.concatenate([self.sums[:, changed], unlinked(one[lacks], other[lacks])], axis=1)
        sums = np.stack([np.bincount(at, values, len(new)) for values in added])
        return _Links(
            np.concatenate([self.low[rest], low]),
            np.concatenate([self.high[rest], high]),
            np.concatenate([self.sums[:, rest], sums], axis=1),
        )


def _join(evidence: TrackletOverlaps, usual: np.ndarray, hints: np.ndarray) -> np.ndarray:
    """Join the best pairs of groups until none is good enough; groups seen side by side stay apart. [T]

    Each round joins all pairs whose groups have no better partner. The affinity of a joined group with another is a
    mean of those of its parts, so the joins of a round do not change which pairs are best.

    Args:
        usual: Result of `_usual`. [V, V]
        hints: Result of `_hints`. [P]
    """
    labels, lengths = np.arange(len(evidence.views)), evidence.lengths.astype(float)
    low, high = evidence.rows.astype(int), evidence.columns.astype(int)
    expected = _expected(evidence, usual, low, high, evidence.union)
    links = _Links(low, high, np.stack([evidence.common * hints, expected, evidence.together]))
    while len(pairs := links.best(lengths)):
        low, high = links.low[pairs], links.high[pairs]
        links = links.join(pairs, _UnlinkedSums(evidence, usual, labels))
        target = np.arange(len(labels))
        target[high] = low
        labels = target[labels]
        lengths[low] += lengths[high]
    return labels


def _expected(
    evidence: TrackletOverlaps, usual: np.ndarray, rows: np.ndarray, columns: np.ndarray, union: np.ndarray
) -> np.ndarray:
    """Weight that pairs of tracklets would have in common if each were one object. [P]"""
    lengths, pixels, at = evidence.lengths, evidence.pixels, evidence.view_index
    thin = THIN * np.minimum(pixels[rows], pixels[columns]) * lengths[rows] * lengths[columns]
    return usual[at[rows], at[columns]] * (union + thin)


class _UnlinkedSums:
    """Sums over the tracklets of two groups that share no Gaussians."""

    def __init__(self, evidence: TrackletOverlaps, usual: np.ndarray, labels: np.ndarray) -> None:
        self._evidence, self._usual = evidence, usual
        self._sizes = np.bincount(labels, minlength=len(labels))
        self._members, self._starts = np.argsort(labels, kind="stable"), np.cumsum(self._sizes) - self._sizes

    def __call__(self, ones: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return `_Links.sums` of groups. [M], [M] -> [3, M]"""
        result = np.zeros((3, len(ones)))
        counts = self._sizes[ones] * self._sizes[others]
        for some in tracklet_overlaps.batches(counts, tracklet_overlaps.CHUNK):
            of, at = tracklet_overlaps.ragged(counts[some])
            one, other = ones[some][of], others[some][of]
            row, column = np.divmod(at, self._sizes[other])
            row, column = self._members[self._starts[one] + row], self._members[self._starts[other] + column]
            union = self._evidence.seen(row, column)
            values = _expected(self._evidence, self._usual, row, column, union)
            result[1, some] = np.bincount(of, values)
            result[2, some] = np.bincount(of, self._evidence.shared_images(row, column))
        return result


def _absorb(evidence: TrackletOverlaps, labels: np.ndarray) -> np.ndarray:
    """Join groups to a larger group that contains them if fewer than half of its images show both.

    This undoes splits by the tracker. Two objects that a tracker sometimes merges behave the opposite way: they are
    mostly seen apart.
    """
    groups, at = np.unique(labels, return_inverse=True)
    count = len(groups)
    member = sparse.csr_matrix((np.ones(len(at), np.float32), (at, np.arange(len(at)))))
    visible, images = member @ evidence.visible, sparse.csr_matrix(member @ evidence.images)
    one, other = at[evidence.rows], at[evidence.columns]
    inner, itself = one == other, np.arange(count)
    own = np.bincount(at, evidence.own, count) + 2 * np.bincount(one[inner], evidence.common[inner], count)
    lengths = np.bincount(at, evidence.lengths, count)
    usual = _median(own / np.maximum(tracklet_overlaps.summed(visible, images, itself, itself), 1e-9), lengths)
    one, other, common = one[~inner], other[~inner], evidence.common[~inner]
    key, pair = np.unique(np.append(one * count + other, other * count + one), return_inverse=True)
    part, whole = np.divmod(key, count)
    seen = tracklet_overlaps.summed(visible, images, part, whole)
    inside = np.bincount(pair, np.append(common, common), len(key)) / np.maximum(seen, 1e-9)
    together = tracklet_overlaps.summed(images.toarray(), images, part, whole)
    links, target = np.split(np.arange(len(key)), np.searchsorted(part, itself[1:])), itself.copy()
    for k in np.argsort(lengths, kind="stable"):
        pairs = links[k]
        pairs = pairs[(lengths[whole[pairs]] > 2 * lengths[k]) & (target[whole[pairs]] == whole[pairs])]
        if not len(pairs):
            continue
        best = pairs[inside[pairs].argmax()]
        if inside[best] >= PART * usual and together[best] < 0.5 * lengths[whole[best]]:
            target[k] = whole[best]
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

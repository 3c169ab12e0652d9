"""Clustering of tracklets into objects: agglomeration, best pairs first, except pairs seen side by side.

The overlap of two views of one object depends on the accuracy of the geometry and on the commonly visible part, so a
fixed threshold fails. The usual IoU between two views is measured first, from tracklets that are mutual best matches;
all thresholds are relative to it. Incoming ids are weighted by the frequency at which tracklets of one object share an
id, compared with other tracklets.

Notation: T tracklets, P pairs of tracklets that share Gaussians, V views.
"""

from __future__ import annotations

import functools
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


def cluster(evidence: TrackletOverlaps) -> np.ndarray:
    """Join tracklets to objects.

    Returns:
        Object of each tracklet, numbered by descending total number of pixels. [T]
    """
    count = len(evidence.views)
    if not count:
        return np.zeros(0, int)
    mutual = _mutual(evidence)
    labels = _join(_Sums(evidence, _usual(evidence, mutual), _hints(evidence, mutual)))
    labels = _absorb(evidence, labels)
    size = np.bincount(labels, evidence.lengths * evidence.pixels, minlength=count)
    rank = np.empty(count, int)
    rank[np.argsort(-size, kind="stable")] = np.arange(count)
    return rank[labels]


def _mutual(evidence: TrackletOverlaps) -> np.ndarray:
    """Indices of tracklet pairs that are mutual best matches in each other's view. [M]"""
    rows, columns = evidence.pairs
    at, ious = evidence.view_index, evidence.ious
    best = np.zeros((len(at), at.max() + 1), np.float32)  # of each tracklet in each view
    sides = [(rows, at[columns]), (columns, at[rows])]
    for side in sides:
        np.maximum.at(best, side, ious)
    return np.flatnonzero((ious > 0) & (ious >= best[sides[0]]) & (ious >= best[sides[1]]))


def _usual(evidence: TrackletOverlaps, mutual: np.ndarray) -> np.ndarray:
    """Usual IoU of tracklets of one object between two views, see `TrackletOverlaps.view_index`. [V, V]"""
    at = evidence.view_index
    views = int(at.max()) + 1
    rows, columns = (side[mutual] for side in evidence.pairs)
    if not len(rows):
        return np.ones((views, views))
    weight = np.minimum(evidence.lengths[rows], evidence.lengths[columns]).astype(float)
    found = evidence.ious[mutual].astype(float)
    everywhere = _median(found, weight)
    table = np.full((views, views), everywhere)
    low, high = np.minimum(at[rows], at[columns]), np.maximum(at[rows], at[columns])
    pair, members = np.unique(low * views + high, return_inverse=True)
    counts = np.bincount(members)
    usual = (_medians(found, weight, members) * counts + everywhere * PRIOR) / (counts + PRIOR)
    table.flat[pair] = table.T.flat[pair] = usual
    return table


def _hints(evidence: TrackletOverlaps, mutual: np.ndarray) -> np.ndarray:
    """Factors on the affinity for different and equal ids, between views and within a view. [2, 2]"""
    rows, columns = (side[mutual] for side in evidence.pairs)
    equal = evidence.ids[rows] == evidence.ids[columns]
    within = evidence.views[rows] == evidence.views[columns]
    weight = np.minimum(evidence.lengths[rows], evidence.lengths[columns])
    factors = np.ones((2, 2))
    for scope, (everything, alike) in enumerate(_least_lengths(evidence)):
        likely = float(weight[within == scope].sum())
        if not likely:
            continue
        trust, chance = float(weight[(within == scope) & equal].sum()) / likely, alike / everything
        if trust <= chance:
            continue
        more, less = (np.sqrt((a + 0.05) / (b + 0.05)) for a, b in ((trust, chance), (1 - trust, 1 - chance)))
        factors[scope] = max(less, 1 / HINT), min(more, HINT)
    return factors


def _least_lengths(evidence: TrackletOverlaps) -> tuple[tuple[float, float], tuple[float, float]]:
    """Sum the shorter length over all pairs of tracklets that never appear together.

    Returns:
        Sums over the pairs of different views, all and those with equal ids, and the same over pairs of one view.
    """
    lengths, views, ids = evidence.lengths, evidence.views, evidence.ids
    within, alike = _least_sum(lengths, [views]), _least_sum(lengths, [views, ids])
    between = _least_sum(lengths, []) - within, _least_sum(lengths, [ids]) - alike
    rows_at_once = tracklet_overlaps.ROWS
    for start in range(0, len(views), rows_at_once):  # in different views, no tracklets appear together
        together = sparse.coo_matrix(evidence.images[start : start + rows_at_once] @ evidence.images.T)
        rows, columns = together.row + start, together.col
        least = np.minimum(lengths[rows], lengths[columns]) * (rows < columns)
        within -= float(least.sum())
        alike -= float(least[ids[rows] == ids[columns]].sum())
    return between, (within, alike)


def _least_sum(lengths: np.ndarray, keys: list[np.ndarray]) -> float:
    """Sum the shorter length over all pairs of tracklets with equal keys."""
    order = np.lexsort([lengths, *keys])
    new = np.zeros(len(order), bool)
    for key in keys:
        new[1:] |= np.diff(key[order]) != 0
    group = np.cumsum(new)
    longer = np.cumsum(np.bincount(group))[group] - 1 - np.arange(len(order))
    return float((lengths[order] * longer).sum())


class _Sums:
    """Sums over pairs of tracklets that decide if they are one object.

    The first one is the common weight, with a factor for the ids. The second is the common weight that is usual for one
    object. The third is the number of images that show both. The affinity of two groups is the first divided by the
    second.

    Args:
        usual: Result of `_usual`. [V, V]
        hints: Result of `_hints`. [2, 2]
    """

    def __init__(self, evidence: TrackletOverlaps, usual: np.ndarray, hints: np.ndarray) -> None:
        self.evidence, self._usual, self._hints = evidence, usual, hints

    def of_tracklets(self, rows: np.ndarray, columns: np.ndarray, common: np.ndarray, union: np.ndarray) -> np.ndarray:
        """Return the sums of pairs of tracklets with their common weight and their union. [M] each -> [3, M]"""
        known = self.evidence
        lengths, pixels, at = known.lengths, known.pixels, known.view_index
        thin = THIN * np.minimum(pixels[rows], pixels[columns]) * lengths[rows] * lengths[columns]
        expected = self._usual[at[rows], at[columns]] * (union + thin)
        hints = self._hints[np.equal(at[rows], at[columns]) * 1, np.equal(known.ids[rows], known.ids[columns]) * 1]
        return np.stack([common * hints, expected, known.together(rows, columns)])

    def of_groups(self, labels: np.ndarray, ones: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the sums of pairs of groups.

        Args:
            labels: Group of each tracklet. [T]
            ones: First group of each pair. [M]
            others: Second group of each pair. [M]

        Returns:
            The sums. [3, M]
        """
        sizes = np.bincount(labels, minlength=len(labels))
        members, starts = np.argsort(labels, kind="stable"), np.cumsum(sizes) - sizes
        result = np.zeros((3, len(ones)))
        counts = sizes[ones] * sizes[others]
        for some in tracklet_overlaps.batches(counts, tracklet_overlaps.CHUNK):
            of, at = tracklet_overlaps.ragged(counts[some])
            row, column = np.divmod(at, sizes[others[some]][of])
            row, column = members[starts[ones[some]][of] + row], members[starts[others[some]][of] + column]
            common = self.evidence.common_of(row, column)
            values = self.of_tracklets(row, column, common, self.evidence.seen(row, column) - common)
            result[:, some] = [np.bincount(of, value) for value in values]
        return result


@dataclass(frozen=True)
class _Links:
    """Pairs of groups that may become one: some of their tracklets have an affinity of at least `SAME`.

    The affinity of groups is a mean of the affinities of their tracklets, so no other groups can be joined.

    Attributes:
        low: First group of each pair, less than the second. [P]
        high: Second group of each pair. [P]
        sums: Sums of each pair, see `_Sums`. [3, P]
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

    def join(self, pairs: np.ndarray, others: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> _Links:
        """Join the groups of pairs; the low group keeps its number.

        Args:
            pairs: Indices of pairs without a common group.
            others: Returns the sums of pairs of groups that are no links. [M], [M] -> [3, M]
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
        # A new pair is the sum of up to four pairs, not all of which are links.
        parts = (1 + (partner[low] >= 0)) * (1 + (partner[high] >= 0))
        lacking = np.bincount(at, minlength=len(new)) < parts
        partial, linked = np.flatnonzero(lacking), changed[lacking[at]]
        one, other = low[partial], high[partial]
        one = np.stack([one, one, partner[one], partner[one]])
        other = np.stack([other, partner[other], other, partner[other]])
        key = np.minimum(one, other) * count + np.maximum(one, other)
        lacks = (one >= 0) & (other >= 0) & ~np.isin(key, self.low[linked] * count + self.high[linked])
        at = np.concatenate([at, partial[np.nonzero(lacks)[1]]])
        added = np.concatenate([self.sums[:, changed], others(one[lacks], other[lacks])], axis=1)
        sums = np.stack([np.bincount(at, values, len(new)) for values in added])
        return _Links(
            np.concatenate([self.low[rest], low]),
            np.concatenate([self.high[rest], high]),
            np.concatenate([self.sums[:, rest], sums], axis=1),
        )


def _join(sums: _Sums) -> np.ndarray:
    """Join the best pairs of groups until none is good enough; groups seen side by side stay apart. [T]

    Each round joins all pairs whose groups have no better partner. The affinity of a joined group with another is a
    mean of those of its parts, so the joins of a round do not change which pairs are best.
    """
    lengths = sums.evidence.lengths.astype(float)
    labels = np.arange(len(lengths))
    links = _links(sums)
    while len(pairs := links.best(lengths)):
        low, high = links.low[pairs], links.high[pairs]
        links = links.join(pairs, functools.partial(sums.of_groups, labels))
        target = np.arange(len(labels))
        target[high] = low
        labels = target[labels]
        lengths[low] += lengths[high]
    return labels


def _links(sums: _Sums) -> _Links:
    """Links of single tracklets."""
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros((3, 0)))]
    known = sums.evidence
    for some, rows, columns in known.chunks():
        values = sums.of_tracklets(
            rows, columns, known.common.data[some].astype(float), known.union[some].astype(float)
        )
        good = values[0] >= SAME * (1 - 1e-9) * values[1]
        found.append((rows[good].astype(int), columns[good].astype(int), values[:, good]))
    return _Links(*(np.concatenate(field, axis=-1) for field in zip(*found, strict=True)))


def _absorb(evidence: TrackletOverlaps, labels: np.ndarray) -> np.ndarray:
    """Join groups to a larger group that contains them if fewer than half of its images show both.

    This undoes splits by the tracker. Two objects that a tracker sometimes merges behave the opposite way: they are
    mostly seen apart.
    """
    groups, at = np.unique(labels, return_inverse=True)
    count = len(groups)
    member = sparse.csr_matrix((np.ones(len(at), np.float32), (at, np.arange(len(at)))))
    visible, images = member @ evidence.visible, sparse.csr_matrix(member @ evidence.images)
    common, itself = sparse.coo_matrix(member @ evidence.common @ member.T), np.arange(count)
    inner = common.row == common.col
    own = np.bincount(at, evidence.own, count) + 2 * np.bincount(common.row[inner], common.data[inner], count)
    lengths = np.bincount(at, evidence.lengths, count)
    usual = _median(own / np.maximum(tracklet_overlaps.summed(visible, images, itself, itself), 1e-9), lengths)
    outer = sparse.coo_matrix((common.data[~inner], (common.row[~inner], common.col[~inner])), common.shape)
    outer = sparse.csr_matrix(outer + outer.T)
    part, whole = np.repeat(itself, np.diff(outer.indptr)), outer.indices
    inside = outer.data / np.maximum(tracklet_overlaps.summed(visible, images, part, whole), 1e-9)
    together = tracklet_overlaps.summed(images.toarray(), images, part, whole)
    links, target = np.split(np.arange(outer.nnz), outer.indptr[1:-1]), itself.copy()
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

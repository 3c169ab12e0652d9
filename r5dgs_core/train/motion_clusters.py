"""Segmentation of point trajectories into rigidly moving parts, without masks.

Points that stay close to each other and keep their distances are likely to belong to one body. Small neighbourhoods
propose rigid motions. The proposal with the largest weight of connected inliers is refitted to them, and they are
removed, until too few points are left. Then parts that one rigid motion explains are merged, and points near a part
that move with it are added.

Notation: R points, S times, H proposals, K neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from ..motion.rigid_path import RigidPath, fit

SHARE = 0.12  # allowed residual / travel of a point; fields bend rigid motions slightly
PROPOSALS = 48  # per part
NEIGHBOURHOOD = 24  # points per proposal
NEIGHBOURS = 8  # nearest neighbours that a point may be connected with
REACH = 4.0  # maximum connection / median distance of nearest neighbours
REFITS = 4
MERGE_INLIERS = 0.7  # minimum share of inliers in both parts for a merge
MERGE_FACTOR = 1.5  # factor on the allowed residual for a merge
ATTACH_FACTOR = 1.5  # factor on the allowed residual for points that are added at the end
MAX_POINTS = 4000  # maximum number of sampled points


def find(paths: np.ndarray, weights: np.ndarray, tolerance: float, fewest: int, rng: np.random.Generator) -> np.ndarray:
    """Label points by rigid part.

    Args:
        paths: Positions of the points over time. [R, S, 3]
        weights: Weights of the points. [R]
        tolerance: Residual allowed for points that hardly move, units of the paths.
        fewest: Minimum number of points of a part; smaller parts are dropped.
        rng: Random generator.

    Returns:
        Part of each point, 0 for the heaviest, -1 for none. [R]
    """
    labels = np.full(len(paths), -1)
    if len(paths) < max(fewest, 4) or paths.shape[1] < 2:
        return labels
    reference = paths.shape[1] // 2
    allowed = _allowed(paths, tolerance)
    sampled = rng.permutation(len(paths))[:MAX_POINTS]
    parts = _parts(paths[sampled], weights[sampled], allowed[sampled], reference, fewest, rng)
    parts = _joined(paths[sampled], weights[sampled], allowed[sampled], reference, parts)
    parts.sort(key=lambda rows: -weights[sampled][rows].sum())
    motions = []
    for k, rows in enumerate(parts):
        labels[sampled[rows]] = k
        motions.append(fit(paths[sampled[rows]], weights[sampled[rows]], reference))
    return _attached(paths, allowed, reference, labels, motions)


def attach(paths: np.ndarray, weights: np.ndarray, tolerance: float, labels: np.ndarray) -> np.ndarray:
    """Extend the labels of `find` to points that were not in its input and that move with a part near them.

    Args:
        paths: Positions of the points over time. [R, S, 3]
        weights: Weights of the points. [R]
        tolerance: Residual allowed for points that hardly move, units of the paths.
        labels: Part of each point, -1 for none; parts of fewer than four points are not extended. [R]
    """
    reference = paths.shape[1] // 2
    motions = []
    for part in range(int(labels.max(initial=-1)) + 1):
        rows = labels == part
        motions.append(fit(paths[rows], weights[rows], reference) if rows.sum() > 3 else None)
    return _attached(paths, _allowed(paths, tolerance), reference, labels, motions)


def _allowed(paths: np.ndarray, tolerance: float) -> np.ndarray:
    """Largest residual at which a point is an inlier. [R]"""
    return tolerance + SHARE * np.linalg.norm(paths - paths.mean(1, keepdims=True), axis=-1).max(1)


def _parts(
    paths: np.ndarray, weights: np.ndarray, allowed: np.ndarray, reference: int, fewest: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """Extract connected sets of inliers of one rigid motion, one after another. Returns the rows of each."""
    features = _features(paths)
    graph = _graph(features)
    left = np.ones(len(paths), bool)
    parts: list[np.ndarray] = []
    while left.sum() >= max(fewest, 4):
        rows = np.flatnonzero(left)
        count = min(NEIGHBOURHOOD, len(rows))
        seeds = rng.choice(len(rows), min(PROPOSALS, len(rows)), replace=False)
        near = np.reshape(KDTree(features[rows]).query(features[rows[seeds]], k=count)[1], (len(seeds), count))
        proposed = fit(paths[rows[near]], weights[rows[near]], reference)
        best, most = np.zeros(0, np.int64), 0.0
        for h, seed in enumerate(rows[seeds]):
            motion = RigidPath(proposed.rotmats[h], proposed.shifts[h])
            explained = left & (motion.residuals(paths, reference) < allowed)
            if weights[explained].sum() <= most:
                continue
            members = _connected(graph, explained, seed)
            for _ in range(REFITS):
                if len(members) < 4:
                    break
                motion = fit(paths[members], weights[members], reference)
                members = _connected(graph, left & (motion.residuals(paths, reference) < allowed), seed)
            if weights[members].sum() > most:
                best, most = members, float(weights[members].sum())
        if len(best) < fewest:
            break
        parts.append(best)
        left[best] = False
    return parts


def _features(paths: np.ndarray) -> np.ndarray:
    """Return features of the paths: the distance between two features is the root mean squared distance of their
    paths over time. [R, S * 3]"""
    return paths.reshape(len(paths), -1) / np.sqrt(paths.shape[1])


def _graph(features: np.ndarray) -> sparse.csr_matrix:
    """Adjacency of points that are close in root mean square distance over time. [R, R]"""
    count = min(NEIGHBOURS + 1, len(features))
    found = KDTree(features).query(features, k=count)
    distance, index = np.asarray(found[0]), np.asarray(found[1])
    longest = REACH * np.median(distance[:, 1:])
    rows = np.repeat(np.arange(len(features)), count - 1)
    good = distance[:, 1:].ravel() <= longest
    shape = (len(features), len(features))
    graph = sparse.csr_matrix((np.ones(good.sum()), (rows[good], index[:, 1:].ravel()[good])), shape=shape)
    return (graph + graph.T).tocsr()


def _connected(graph: sparse.csr_matrix, members: np.ndarray, seed: int) -> np.ndarray:
    """Rows of the members [R] bool that are connected with the seed through members."""
    rows = np.flatnonzero(members)
    if not members[seed]:
        return rows[:0]
    _, labels = csgraph.connected_components(graph[rows][:, rows], directed=False)
    return rows[labels == labels[np.searchsorted(rows, seed)]]


def _joined(
    paths: np.ndarray, weights: np.ndarray, allowed: np.ndarray, reference: int, parts: list[np.ndarray]
) -> list[np.ndarray]:
    """Merge neighbouring parts that one motion explains."""
    parts = list(parts)
    features = _features(paths)
    spacing = REACH * np.median(KDTree(features).query(features, k=2)[0][:, 1])
    k = 0
    while k < len(parts):
        for other in range(k + 1, len(parts)):
            pair = (parts[k], parts[other])
            both = np.concatenate(pair)
            gap = KDTree(features[parts[k]]).query(features[parts[other]])[0].min()
            if gap > spacing:
                continue
            balance = np.concatenate([np.full(len(p), 1 / weights[p].sum()) for p in pair])
            motion = fit(paths[both], weights[both] * balance, reference)
            if all(
                (motion.residuals(paths[p], reference) < MERGE_FACTOR * allowed[p]).mean() > MERGE_INLIERS for p in pair
            ):
                parts[k] = both
                del parts[other]
                break
        else:
            k += 1
    return parts


def _attached(
    paths: np.ndarray, allowed: np.ndarray, reference: int, labels: np.ndarray, motions: Sequence[RigidPath | None]
) -> np.ndarray:
    """Return the labels, extended to points near a part that move with it. [R]"""
    labels = labels.copy()
    open_rows = np.flatnonzero(labels < 0)
    if len(open_rows) == 0 or not motions:
        return labels
    features = _features(paths)
    best = np.full(len(open_rows), np.inf)
    for k, motion in enumerate(motions):
        if motion is None:
            continue
        members = np.flatnonzero(labels == k)
        tree = KDTree(features[members])
        spacing = np.median(tree.query(features[members], k=min(2, len(members)))[0][..., -1])
        off = motion.residuals(paths[open_rows], reference) / allowed[open_rows]
        likely = np.flatnonzero((off < ATTACH_FACTOR) & (off < best))
        reach = 2 * REACH * spacing
        chosen = likely[tree.query(features[open_rows[likely]], distance_upper_bound=reach)[0] < reach]
        labels[open_rows[chosen]], best[chosen] = k, off[chosen]
    return labels

"""Rigid parts of a body, from the paths of its Gaussians, and tracks with one body per part.

Notation: R members of the body, S knots. Paths have the canonical positions first, then those at the knots.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ..model import track_state
from ..motion import rigid_path, rotations
from . import motion_clusters

TOLERANCES = (0.02, 0.01, 0.005)  # residuals allowed in the search for parts, relative to the size of the body
MIN_SHARE = 0.08  # minimum share of a part in the members
MIN_MEMBERS = 8  # minimum number of members of a part
NEIGHBOURS = 8  # members over which residuals are averaged before a member joins a part
ROUNDS = 12  # rounds of joining and refitting
EXPLAINED = 0.8  # maximum distance from the motions of the parts, relative to that from one motion
ALIKE = 1.3  # maximum growth of the distance by which two parts become one


def find(paths: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Divide the members of a body into rigid parts.

    Args:
        paths: Canonical positions, then those at the knots. [R, 1 + S, 3]
        weights: Weights of the members. [R]
        rng: Random generator.

    Returns:
        Part of each member, 0 for the heaviest; None if several parts do not explain the paths clearly better than one.
        [R]
    """
    fewest = max(MIN_MEMBERS, int(MIN_SHARE * len(paths)))
    if len(paths) < 2 * fewest:
        return None
    middle = np.median(paths[:, 0], axis=0)
    size = float(np.quantile(np.linalg.norm(paths[:, 0] - middle, axis=1), 0.9))
    for tolerance in TOLERANCES:  # a wide tolerance joins parts that hardly move against each other
        labels = motion_clusters.find(paths[:, 1:], weights, tolerance * size, fewest, rng)
        if labels.max() > 0:
            break
    else:
        return None
    labels = _refined(paths, weights, labels)
    while labels.max() > 1:
        merged = [
            _refined(paths, weights, np.where(labels == b, a, labels)) for a, b in combinations(_parts(labels), 2)
        ]
        best = min(merged, key=lambda found: distance(paths, weights, found))
        if distance(paths, weights, best) > ALIKE * distance(paths, weights, labels):
            break
        labels = best
    one = distance(paths, weights, np.zeros(len(paths), np.int64))
    smallest = min(np.bincount(labels))
    if labels.max() < 1 or smallest < fewest or distance(paths, weights, labels) > EXPLAINED * one:
        return None
    return labels


def distance(paths: np.ndarray, weights: np.ndarray, labels: np.ndarray) -> float:
    """Return the root mean square distance of the members from the rigid motions of their parts."""
    squares = _residuals(paths, weights, labels)[np.arange(len(paths)), labels] ** 2
    return float(np.sqrt(np.average(squares, weights=weights)))


def _parts(labels: np.ndarray) -> range:
    return range(int(labels.max()) + 1)


def _residuals(paths: np.ndarray, weights: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the distance of each member from the rigid motion of each part. [R, P]"""
    fits = [rigid_path.fit(paths[labels == k], weights[labels == k], 0) for k in _parts(labels)]
    return np.stack([fit.residuals(paths, 0) for fit in fits], axis=1)


def _refined(paths: np.ndarray, weights: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the parts after members joined the part whose motion fits them and their neighbours best, heaviest first.

    Parts that lose their members disappear; members without a part (-1) join one.
    """
    near = np.asarray(KDTree(paths[:, 0]).query(paths[:, 0], k=min(NEIGHBOURS, len(paths)))[1])
    for _ in range(ROUNDS):
        masses = np.array([weights[labels == k].sum() for k in _parts(labels)])
        kept = [k for k in np.argsort(-masses, kind="stable") if (labels == k).sum() >= 4]
        ranks = np.full(len(masses) + 1, -1)
        ranks[kept] = np.arange(len(kept))
        labels = ranks[labels]
        squares = _residuals(paths, weights, labels) ** 2
        share = weights[near] / weights[near].sum(1, keepdims=True)
        found = np.einsum("rk,rkp->rp", share, squares[near]).argmin(1)
        if (found == labels).all():
            break
        labels = found
    return labels


def split(
    tensors: Mapping[str, Tensor],
    body: int,
    rows: np.ndarray,
    labels: np.ndarray,
    paths: np.ndarray,
    weights: np.ndarray,
) -> dict[str, Tensor]:
    """Return the tensors of a state in which each part of a body is a body with its own track.

    Part 0 keeps the body's number; the others come after all bodies and before the shadows.

    Args:
        tensors: The state.
        body: The body.
        rows: Its members. [R]
        labels: Their parts. [R]
        paths: Their paths. [R, 1 + S, 3]
        weights: Their weights. [R]
    """
    tracks = track_state.tracks_of(tensors)
    tracks.rebase()
    bodies, more = tracks.bodies, int(labels.max())
    ids = tensors["gaussians.motion_ids"].clone()
    ids[ids >= bodies] += more
    ids[torch.from_numpy(rows)] = torch.from_numpy(np.where(labels > 0, bodies + labels - 1, body)).to(ids.dtype)
    numbers = [body, *range(bodies, bodies + more)]
    changed = {"gaussians.motion_ids": ids, track_state.OWNERS: _extended(tracks.owners, body, more)}
    for name, tensor in tensors.items():
        last = name.rpartition(".")[2] if name.startswith("tracks.") else name
        if last in ("centers", "translations", "rotvecs", "base_quats"):
            changed[name] = _extended(tracks.base_quats if last == "base_quats" else tensor, body, more)
        elif name.startswith(("adam.translations.", "adam.rotvecs.")) and tensor.ndim:
            changed[name] = torch.cat([tensor, torch.zeros(more, *tensor.shape[1:])])
    changed["tracks.rotvecs"].zero_()
    for part, number in enumerate(numbers):
        mine = labels == part
        motion = rigid_path.fit(paths[mine], weights[mine], 0)
        center = np.average(paths[mine, 0], axis=0, weights=weights[mine])
        quats = rotations.make_continuous(rotations.rotmats_to_quats(motion.rotmats[1:]))
        moves = motion.rotmats[1:] @ center + motion.shifts[1:] - center
        for name, value in (("centers", center), ("base_quats", quats), ("translations", moves)):
            changed[f"tracks.{name}"][number] = torch.from_numpy(value).float()
    return {**tensors, **changed}


def _extended(tensor: Tensor, body: int, more: int) -> Tensor:
    """Return a tensor with further rows, equal to that of a body."""
    return torch.cat([tensor, tensor[body].expand(more, *tensor.shape[1:])])

"""Clean-up of object labels by spatial neighbours, motion and outlier removal.

The vote of the masks (`label_votes.votes`) leaves Gaussians undecided that lie on an outline, are shown by few
masks, or are claimed by wrong masks. Only the labels of undecided Gaussians change, according to their neighbours and
to the group that they move with. `regrouping` is the corresponding rule for motion groups.

Notation: N Gaussians, C classes (0 the background); v the votes [N, C] in pixels of blending weight; p the shares of a
Gaussian's votes, each divided by the `certainty` of its class (if masks miss an object in one image of five, even its
interior has a share of only 0.8); t / (t + 1 px) the trust in t pixels of votes.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse, spatial
from scipy.sparse import csgraph

from ...motion import rotations
from ...scene import visibility
from .. import observed_motion
from ..observed_motion import GroupTrack

log = logging.getLogger(__name__)

CHANGES = "label_changes"  # name of the counts in a checkpoint, in the order of `LabelChanges`

NEIGHBOURS = 8
OWN_WEIGHT = 4.0  # weight of a Gaussian's own votes relative to its neighbourhood
MOTION_WEIGHT = 0.5  # weight of the group that it moves with relative to its neighbourhood
HALF_TRUST_VOTES = 1.0  # votes with a trust of one half, pixels
# a Gaussian of an object keeps its label if more than this (trusted) share of the votes for its old and new label is
# for the old one
UNDECIDED = 0.55
UNDECIDED_BACKGROUND = 0.45  # the same for Gaussians of the background
MAX_LINK = 5.0  # maximum link between members of an object / their typical spacing
MAX_OUTLIER_SHARE = 0.05  # maximum share of an outlier part in the total opacity of its object
MAX_OUTLIER_SUPPORT = 0.65  # maximum trusted share of the votes of an outlier part
MIN_MEMBERS = 9  # minimum number of members for statistics of an object
MIN_DISPLACEMENT = 0.1  # minimum displacement of moving objects, relative to their radius
MIN_CERTAINTY = 0.5  # minimum median certainty of the objects; below it, the masks contradict each other
BLOCK_SIZE = 1 << 16  # Gaussians per block; bounds memory


@dataclass(frozen=True)
class LabelChanges:
    """Counts of changed labels by cause.

    Attributes:
        neighbours: Changed by the spatial neighbours.
        motion: Changed because of the motion group; the neighbours alone would not have changed the label.
        outliers: Changed because they lie apart from their object and have few votes for it.
        gaussians: Number of Gaussians in total.
    """

    neighbours: int = 0
    motion: int = 0
    outliers: int = 0
    gaussians: int = 0


def clean(
    votes: np.ndarray,
    labels: np.ndarray,
    points: np.ndarray,
    opacities: np.ndarray,
    companion_classes: np.ndarray | None = None,
    moving_classes: np.ndarray | None = None,
) -> tuple[np.ndarray, LabelChanges]:
    """Clean labels by neighbours, motion and outlier removal.

    An object never loses all its Gaussians, and nearly transparent Gaussians never join an object. No label changes if
    the masks contradict each other even in the interior of objects.

    Args:
        votes: Votes of the masks. [N, C]
        labels: Class of each Gaussian by the votes, or by its motion group if it has none. [N]
        points: Centres in the bind state. [N, 3]
        opacities: [N]
        companion_classes: Class of the body that a Gaussian moves with, 0 for none; None if unknown. [N]
        moving_classes: Classes that differ from the background by their motion. [C] bool

    Returns:
        Classes [N] int64, and the counts of changes.
    """
    start, count = labels.astype(np.int64), votes.shape[1]
    if len(votes) < 2 or count < 2:
        return start, LabelChanges(gaussians=len(votes))
    width = min(NEIGHBOURS, len(points) - 1) + 1
    distances, nearest = map(np.asarray, spatial.KDTree(points).query(points, width))
    votes = votes.astype(np.float32)
    total = votes.sum(axis=1)
    shares = votes / np.maximum(total, 1e-9)[:, None]
    sure = certainty(shares, start, total, opacities, nearest)
    measured = sure[1:][np.isfinite(sure[1:])]
    if len(measured) and np.median(measured) < MIN_CERTAINTY:
        log.warning("masks contradict each other about the objects: labels are not cleaned")
        return start, LabelChanges(gaussians=len(votes))
    shares /= np.where(np.isnan(sure), 1.0, np.maximum(sure, MIN_CERTAINTY)).astype(np.float32)
    shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1e-9)
    trust = total / (total + HALF_TRUST_VOTES)
    pull = _pull(start, companion_classes, moving_classes, count)
    found, motion = start.copy(), np.zeros(len(votes), bool)
    for first in range(0, len(votes), BLOCK_SIZE):
        rows = np.arange(first, min(first + BLOCK_SIZE, len(votes)))
        near = distances[rows], nearest[rows]
        found[rows], motion[rows] = _decide(rows, shares, trust, start, opacities, *near, pull)
    found = _keep_objects(start, found, count)
    settled = found
    found = _keep_objects(start, _without_outliers(votes, shares, total, settled, points, opacities), count)
    changed = found != start
    apart = changed & (found != settled)
    by_motion, outliers = int((changed & ~apart & motion).sum()), int(apart.sum())
    return found, LabelChanges(int(changed.sum()) - by_motion - outliers, by_motion, outliers, len(votes))


def certainty(
    shares: np.ndarray, labels: np.ndarray, total: np.ndarray, opacities: np.ndarray, nearest: np.ndarray
) -> np.ndarray:
    """Return the share of votes that a class has in its interior: 1 for clean masks, less if masks miss it.

    The interior consists of Gaussians whose neighbours all have the same label.

    Args:
        shares: Shares of the votes. [N, C]
        labels: [N]
        total: Votes, pixels. [N]
        opacities: [N]
        nearest: Rows of the neighbours of each Gaussian, including itself. [N, k]

    Returns:
        Median share per class; nan for classes with fewer than nine interior Gaussians. [C]
    """
    inner = (labels[nearest] == labels[:, None]).all(axis=1) & (total > HALF_TRUST_VOTES)
    inner &= opacities > visibility.SEEN_OPACITY
    result = np.full(shares.shape[1], np.nan)
    for k in np.unique(labels[inner]):
        own = shares[inner & (labels == k), k]
        if len(own) >= MIN_MEMBERS:
            result[k] = np.median(own)
    return result


def changes_of(tensors: Mapping[str, Any]) -> dict[str, int] | None:
    """Return the counts in a checkpoint by the names of `LabelChanges`; None if labels were not cleaned."""
    if CHANGES not in tensors:
        return None
    names = [field.name for field in dataclasses.fields(LabelChanges)]
    return dict(zip(names, map(int, tensors[CHANGES]), strict=True))


def bind_positions(groups: Sequence[GroupTrack], motion_ids: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Return the centres in the bind state, at the last knot of their groups' tracks. [N, 3]

    Args:
        groups: The motion groups.
        motion_ids: Group of each Gaussian. [N]
        means: Centres that the tracks start from. [N, 3]
    """
    points = means.astype(np.float64)
    for g, group in enumerate(groups):
        members = motion_ids == g
        arms = points[members] - group.center
        points[members] = group.center + rotations.rotate(group.quats[-1], arms) + group.displacements[-1]
    return points


def find_companions(
    groups: Sequence[GroupTrack], motion_ids: np.ndarray, points: np.ndarray, object_ids: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the body that each Gaussian moves with, for `clean`.

    Args:
        groups: The motion groups.
        motion_ids: Group of each Gaussian. [N]
        points: Centres in the bind state, in the coordinates of the groups. [N, 3]
        object_ids: Object id of each class. [C]

    Returns:
        Class of the body, 0 for Gaussians at rest and shadows [N], and a mask of the classes that move by more than a
        tenth of their radius [C] bool.
    """
    rows = {int(object_id): row for row, object_id in enumerate(object_ids)}
    owners, moving_classes = np.zeros(len(groups), np.int64), np.zeros(len(object_ids), bool)
    for g, group in enumerate(groups):
        if group.role != "body":
            continue
        owners[g] = rows[group.object_id]
        members = points[motion_ids == g]
        if len(members) == 0:
            continue
        radius = observed_motion.radius(members, np.median(members, axis=0))
        turned = rotations.multiply(group.quats, rotations.conjugate(group.quats[-1]))
        chords = 2 * np.linalg.norm(turned[:, 1:], axis=1)  # 2 sin(angle / 2)
        went = np.linalg.norm(group.displacements - group.displacements[-1], axis=1) + chords * radius
        moving_classes[owners[g]] |= bool(went.max() > MIN_DISPLACEMENT * radius)
    return owners[motion_ids], moving_classes


def _pull(
    labels: np.ndarray, companion_classes: np.ndarray | None, moving_classes: np.ndarray | None, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the class that the motion of each Gaussian votes for, and the weight of this vote.

    The weight is 0 if that class is at rest. A vote for class 0 (background) has weight 0 if the Gaussian's own class
    is at rest.
    """
    if companion_classes is None or moving_classes is None:
        return np.zeros(len(labels), np.int64), np.zeros(len(labels), np.float32)
    known_moving = np.append(moving_classes, np.zeros(count - len(moving_classes), bool))
    known_moving[0] = False
    has_vote = np.where(companion_classes > 0, known_moving[companion_classes], known_moving[labels])
    return companion_classes.astype(np.int64), (MOTION_WEIGHT * has_vote).astype(np.float32)


def _decide(
    rows: np.ndarray,
    shares: np.ndarray,
    trust: np.ndarray,
    labels: np.ndarray,
    opacities: np.ndarray,
    distances: np.ndarray,
    nearest: np.ndarray,
    pull: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the labels of some Gaussians, and a mask of those changed by motion. [n] and [n] bool

    The tally of a Gaussian is 4 p times trust, plus the mean p of its neighbours (weighted by distance, opacity and
    trust), plus a half for the class that it moves with.
    """
    own = labels[rows]
    spacing = np.maximum(np.median(distances[:, 1:], axis=1), 1e-30)
    weights = np.exp(-((distances / spacing[:, None]) ** 2)) * opacities[nearest] * trust[nearest]
    weights = np.where(nearest == rows[:, None], 0.0, weights).astype(np.float32)
    around = np.zeros((len(rows), shares.shape[1]), np.float32)
    for column, weight in zip(nearest.T, weights.T, strict=True):
        around += weight[:, None] * shares[column]
    whole = weights.sum(axis=1)
    tally = OWN_WEIGHT * trust[rows, None] * shares[rows] + around / np.maximum(whole, 1e-9)[:, None]
    alone = tally.argmax(axis=1)
    preferred, weight = (values[rows] for values in pull)
    tally[np.arange(len(rows)), preferred] += weight
    new = tally.argmax(axis=1)
    said, other = shares[rows, own], shares[rows, new]
    sure = trust[rows] * said / np.maximum(said + other, 1e-9)
    take = (new != own) & (whole > 1e-6)
    take &= sure < np.where(own == 0, UNDECIDED_BACKGROUND, UNDECIDED)
    take &= (new == 0) | (opacities[rows] > visibility.SEEN_OPACITY)
    return np.where(take, new, own), take & (new != alone)


def _without_outliers(
    votes: np.ndarray,
    shares: np.ndarray,
    total: np.ndarray,
    labels: np.ndarray,
    points: np.ndarray,
    opacities: np.ndarray,
) -> np.ndarray:
    """Relabel small parts that lie apart from their object and have few votes for it. [N]

    They join the class with most of their other votes, or else the background. Arguments as for `clean`.
    """
    result = labels.copy()
    for k in range(1, votes.shape[1]):
        rows = np.flatnonzero(labels == k)
        if len(rows) < MIN_MEMBERS:
            continue
        parts, count = _parts(points[rows], opacities[rows])
        if count == 1:
            continue
        mass = np.bincount(parts, opacities[rows], count)
        seen = np.bincount(parts, total[rows], count)
        own = np.bincount(parts, total[rows] * shares[rows, k], count) / np.maximum(seen, 1e-9)
        weak = own * seen / (seen + HALF_TRUST_VOTES) < MAX_OUTLIER_SUPPORT
        for part in np.flatnonzero(weak & (mass < MAX_OUTLIER_SHARE * mass.sum())):
            members = rows[parts == part]
            rest = votes[members].sum(axis=0)
            rest[k] = 0.0
            result[members] = rest.argmax()
    return result


def _parts(points: np.ndarray, opacities: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the connected component of each point and their number; links reach `MAX_LINK` typical spacings."""
    width = min(NEIGHBOURS + 1, len(points))
    distances, nearest = map(np.asarray, spatial.KDTree(points).query(points, width))
    shown = visibility.seen(opacities)
    spacing = np.median(distances[shown if shown.any() else slice(None), width // 2])
    near = distances <= MAX_LINK * spacing
    rows = np.repeat(np.arange(len(points)), width)[near.ravel()]
    links = sparse.coo_matrix((np.ones(len(rows)), (rows, nearest.ravel()[near.ravel()])), (len(points),) * 2)
    count, parts = csgraph.connected_components(links, directed=False)
    return parts, int(count)


def _keep_objects(before: np.ndarray, after: np.ndarray, count: int) -> np.ndarray:
    """Return the new labels, with the old ones for objects that would lose all their Gaussians. [N]"""
    lost = (np.bincount(before, minlength=count) > 0) & (np.bincount(after, minlength=count) == 0)
    lost[0] = False
    return np.where(lost[before], before, after)

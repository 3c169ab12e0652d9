"""Which motion group each moving Gaussian belongs to: the one that it was made for, or one that explains it better.

The label that says what a Gaussian shows is not the label that says how it moves: a Gaussian at the edge of an object,
in its halo or in its shadow may show one thing and go with another. This is the rule of the second label. It needs no
image: it compares where a Gaussian was at the observed times with where each group would have brought it.

Notation: R moving Gaussians with centres x_s at the knots s, last knot T; G groups, 0 the pinned one. A group g takes
x_T to c_g + R_gs (x_T - c_g) + d_gs; the error of a Gaussian in it is the mean over the knots of the distance to x_s.
All thresholds are shares of a group's radius, the distance from its centre that holds nine of ten of its voters.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence

import numpy as np
from scipy import spatial

from ...motion import rotations
from ...playback import visibility
from ..observed_motion import GroupTrack, Moves

log = logging.getLogger(__name__)

BETTER = 0.5  # a Gaussian changes its group where another has less than this share of its error,
NOTICED = 0.08  # its own error is more than this share of the radius,
EXPLAINED = 0.3  # the other one is less than this share,
NEAR = 1.5  # and it lies no further from the other group's members than this share
FLOATING = 2.0  # of the distance that holds nine of ten members: what lies further off has no say
ROUNDS = 8  # groups are fitted again to their new members, and asked again, until none moves
REACH = 4.0  # how far beside its caster, along the plane, a shadow may lie
STEEPEST = 4.0  # of a shadow's way over its caster's rise: light from 14 degrees above the plane
FEWEST = 5  # Gaussians that make a shadow
AT_ONCE = 8192  # Gaussians that are compared with the groups at once; bounds memory


def tidy(
    path: np.ndarray,
    ids: np.ndarray,
    opacities: np.ndarray,
    fit: Callable[[np.ndarray], list[GroupTrack]],
    made_for: np.ndarray | None = None,
) -> tuple[np.ndarray, list[GroupTrack], Moves]:
    """Bring Gaussians to the groups that explain their motion, and fit the groups to them.

    Args:
        path: Centres at the knots. [R, S, 3]
        ids: Their groups. [R]
        opacities: [R]
        fit: The groups for given ids, with poses relative to the last knot.
        made_for: Groups that they were made for, where those are others: what is counted. [R]

    Returns:
        Groups of the Gaussians [R], the groups fitted to them, and what was moved.
    """
    start, groups = ids if made_for is None else made_for, fit(ids)
    for _ in range(ROUNDS):
        found = regroup(path, ids, opacities, groups)
        if (found == ids).all():
            break
        ids, groups = found, fit(found)
    went = ids[ids != start]
    roles = np.array([group.role for group in groups])[went]
    bodies, shadows, rest = (int((roles == role).sum()) for role in ("body", "shadow", "pinned"))
    resting = sum(group.role == "shadow" and not np.any(group.follow_matrix) for group in groups)
    moves = Moves(bodies, shadows, rest, resting, len(ids))
    log.info("%d of %d Gaussians that move go with another group than their object's", moves.moved, moves.moving)
    return ids, groups, moves


def voters(points: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Weights of members in their group's motion: their opacities, without those that float apart. [n]

    Faint members have little say by their weight; to leave them out makes tracks worse (measured against true poses).

    Args:
        points: Centres at the last knot. [n, 3]
        opacities: [n]
    """
    weights = np.maximum(opacities, 1e-12)
    if len(points) == 0:
        return weights
    seen = visibility.seen(opacities)
    distances = np.linalg.norm(points - np.median(points[seen], axis=0), axis=1)
    return np.where(distances <= FLOATING * np.quantile(distances[seen], 0.9), weights, 0.0)


def radii(points: np.ndarray, ids: np.ndarray, opacities: np.ndarray, groups: Sequence[GroupTrack]) -> np.ndarray:
    """Distance from each group's centre that holds nine of ten of its voters, 0 without members. [G]

    Args:
        points: Centres at the last knot. [R, 3]
        ids: Their groups. [R]
        opacities: [R]
        groups: The groups.
    """
    result = np.zeros(len(groups))
    for g, group in enumerate(groups):
        members = _voting(points, ids, opacities, g)
        if len(members):
            result[g] = np.quantile(np.linalg.norm(points[members] - group.center, axis=1), 0.9)
    return result


def errors(path: np.ndarray, rows: np.ndarray, group: GroupTrack) -> np.ndarray:
    """Error of some Gaussians in one group. [n]

    Args:
        path: Centres at the knots. [R, S, 3]
        rows: Which of them. [n]
        group: The group, with poses relative to the last knot.
    """
    rotmats, result = rotations.quats_to_rotmats(group.quats), np.zeros(len(rows))
    for first in range(0, len(rows), AT_ONCE):
        some = path[rows[first : first + AT_ONCE]]
        arms = some[:, -1] - group.center
        for s, (rotmat, shift) in enumerate(zip(rotmats, group.displacements, strict=True)):
            away = arms @ rotmat.T
            away += group.center + shift - some[:, s]
            result[first : first + AT_ONCE] += np.sqrt(np.einsum("nc,nc->n", away, away))
    return result / len(rotmats)


def regroup(path: np.ndarray, ids: np.ndarray, opacities: np.ndarray, groups: Sequence[GroupTrack]) -> np.ndarray:
    """The group of each Gaussian after those that another group explains better went there.

    Args:
        path: Centres at the knots. [R, S, 3]
        ids: Their groups. [R]
        opacities: [R]
        groups: The groups, with poses relative to the last knot.

    Returns:
        Groups. [R] int64

    Source: the rule is that of our study of a prototype on one scene, with lengths restated as shares of a radius. On
        ten fields of five scenes each threshold but `NEAR` may be halved or doubled at less than 0.1 dB; to ask only
        at a sixth of this `NEAR` loses up to 0.9 dB.
    """
    sizes = radii(path[:, -1], ids, opacities, groups)
    own = np.zeros(len(path))
    for g, group in enumerate(groups):
        rows = np.flatnonzero(ids == g)
        own[rows] = errors(path, rows, group)
    best, chosen = np.full(len(path), np.inf), ids.astype(np.int64)
    for g, (group, size) in enumerate(zip(groups, sizes, strict=True)):
        rows = np.flatnonzero((ids != g) & (own > 0))
        # What rests is measured by what it came from: the pinned group has no size.
        scale = sizes[ids[rows]] if g == 0 else np.full(len(rows), size)
        rows, scale = rows[scale > 0], scale[scale > 0]
        noticed = own[rows] > NOTICED * scale
        rows, scale = rows[noticed], scale[noticed]
        if g > 0:
            members = path[_voting(path[:, -1], ids, opacities, g), -1]
            near = _distances(path[rows, -1], members, NEAR * size) <= NEAR * size
            rows, scale = rows[near], scale[near]
        found = errors(path, rows, group)
        take = (found < BETTER * own[rows]) & (found < EXPLAINED * scale) & (found < best[rows])
        best[rows[take]], chosen[rows[take]] = found[take], g
    return chosen


def imitators(
    path: np.ndarray, ids: np.ndarray, opacities: np.ndarray, groups: Sequence[GroupTrack], normal: np.ndarray
) -> np.ndarray:
    """Bodies whose shadow Gaussians of the background imitate: they move along a plane as the body above it does.

    Args:
        path: Centres at the knots. [R, S, 3]
        ids: Their groups; those in group 0 are asked. [R]
        opacities: [R]
        groups: The groups, with poses relative to the last knot.
        normal: Unit normal of the plane. [3]

    Returns:
        The group of the caster, 0 for none. [R] int64
    """
    sizes = radii(path[:, -1], ids, opacities, groups)
    rows, casters = np.flatnonzero(ids == 0), np.zeros(len(ids), np.int64)
    own, best = errors(path, rows, groups[0]), np.full(len(rows), np.inf)
    plane = np.eye(3) - np.outer(normal, normal)
    for g, (group, size) in enumerate(zip(groups, sizes, strict=True)):
        moves = np.linalg.norm(group.displacements, axis=1).max() > NOTICED * size
        if group.role != "body" or size == 0 or not moves:
            continue
        members = path[_voting(path[:, -1], ids, opacities, g), -1] @ plane
        asked = np.flatnonzero(own > NOTICED * size)
        asked = asked[_distances(path[rows[asked], -1] @ plane, members, REACH * size) <= REACH * size]
        slopes, found = _alone(path, rows[asked], group.displacements, plane, normal)
        alike = (found < BETTER * own[asked]) & (found < EXPLAINED * size)
        alike &= np.linalg.norm(slopes, axis=1) < STEEPEST
        if alike.sum() < FEWEST:
            continue
        slope = np.median(slopes[alike], axis=0)  # one light
        shift = group.displacements @ plane + np.outer(group.displacements @ normal, slope)
        shadow = dataclasses.replace(group, quats=rotations.identity(len(shift)), displacements=shift)
        found = errors(path, rows[asked], shadow)
        take = (found < BETTER * own[asked]) & (found < EXPLAINED * size) & (found < best[asked])
        if take.sum() >= FEWEST:
            best[asked[take]], casters[rows[asked[take]]] = found[take], g
    return casters


def _alone(
    path: np.ndarray, rows: np.ndarray, leader: np.ndarray, plane: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What each Gaussian would be as a shadow of its own light: way along the plane per rise [n, 3], and error [n].

    Args:
        path: Centres at the knots. [R, S, 3]
        rows: Which of them. [n]
        leader: Displacements of the caster. [S, 3]
        plane: Projection onto the plane. [3, 3]
        normal: Of the plane. [3]
    """
    slopes, found = np.zeros((len(rows), 3)), np.zeros(len(rows))
    along, rise = leader @ plane, leader @ normal
    scale = max(float(rise @ rise), 1e-6 * float((along**2).sum()), 1e-300)
    for first in range(0, len(rows), AT_ONCE):
        block = slice(first, first + AT_ONCE)
        left = path[rows[block]] - path[rows[block], -1:] - along
        slopes[block] = np.einsum("s,nsc->nc", rise / scale, left) @ plane
        found[block] = np.linalg.norm(left - rise[:, None] * slopes[block, None], axis=-1).mean(1)
    return slopes, found


def _voting(points: np.ndarray, ids: np.ndarray, opacities: np.ndarray, group: int) -> np.ndarray:
    """Rows of the members of a group that say where it is: those that can be seen and do not float apart."""
    rows = np.flatnonzero(ids == group)
    return rows[(voters(points[rows], opacities[rows]) > 0) & visibility.seen(opacities[rows])]


def _distances(points: np.ndarray, members: np.ndarray, limit: float) -> np.ndarray:
    """Distance of points from the nearest member, infinite beyond a limit. [n]"""
    if len(points) == 0 or len(members) == 0:
        return np.full(len(points), np.inf)
    return spatial.KDTree(members).query(points, distance_upper_bound=np.nextafter(limit, np.inf))[0]

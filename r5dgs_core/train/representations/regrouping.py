"""Regrouping: moving Gaussians join the motion group that explains their observed motion best.

The object label of a Gaussian need not be its motion group: at the edge of an object, in its halo or in its shadow, a
Gaussian may show one object and move with another. Regrouping needs no images: it compares the positions of a Gaussian
at the observed times with those predicted by each group.

Notation: R moving Gaussians with centres x_s at the knots s, last knot T; G groups, 0 the pinned one. A group g moves
x_T to c_g + R_gs (x_T - c_g) + d_gs; the error of a Gaussian in it is the mean distance to x_s over the knots. All
thresholds are shares of a group's radius, the 90 % quantile of its voters' distances from its centre.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence

import numpy as np
from scipy import spatial

from ...motion import rotations
from ...scene import visibility
from .. import observed_motion
from ..observed_motion import GroupTrack, RegroupCounts

log = logging.getLogger(__name__)

BETTER = 0.5  # maximum error in the new group / error in the current group
NOTICED = 0.08  # minimum error in the current group, radii
EXPLAINED = 0.3  # maximum error in the new group, radii
NEAR = 1.5  # maximum distance from the members of the new group, radii
FLOATING = 2.0  # distance above which a member is a floater / 90 % quantile of the distances
ROUNDS = 8  # maximum number of rounds of regrouping and refitting
REACH = 4.0  # maximum distance of a shadow from its caster along the plane, radii
STEEPEST = 4.0  # maximum shift of a shadow / rise of its caster: light from 14 degrees above the plane
MIN_SHADOW_SIZE = 5  # minimum number of Gaussians in a shadow
AT_ONCE = 8192  # Gaussians per block; bounds memory


def regroup_until_stable(
    path: np.ndarray,
    ids: np.ndarray,
    opacities: np.ndarray,
    fit: Callable[[np.ndarray], list[GroupTrack]],
    original_ids: np.ndarray | None = None,
) -> tuple[np.ndarray, list[GroupTrack], RegroupCounts]:
    """Regroup Gaussians and refit the groups until no Gaussian changes its group.

    Args:
        path: Centres at the knots. [R, S, 3]
        ids: Their groups. [R]
        opacities: [R]
        fit: Fits the groups to given ids, with poses relative to the last knot.
        original_ids: Original groups for the counts, if they are not ``ids``. [R]

    Returns:
        Groups of the Gaussians [R], the groups fitted to them, and the counts of changes.
    """
    start, groups = ids if original_ids is None else original_ids, fit(ids)
    for _ in range(ROUNDS):
        found = regroup(path, ids, opacities, groups)
        if (found == ids).all():
            break
        ids, groups = found, fit(found)
    went = ids[ids != start]
    roles = np.array([group.role for group in groups])[went]
    bodies, shadows, rest = (int((roles == role).sum()) for role in ("body", "shadow", "pinned"))
    resting = sum(group.role == "shadow" and not np.any(group.follow_matrix) for group in groups)
    moves = RegroupCounts(bodies, shadows, rest, resting, len(ids))
    log.info("%d of %d moving Gaussians joined another group than that of their object", moves.moved, moves.moving)
    return ids, groups, moves


def fit_weights(points: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Return the weights of members in the fit of their group: their opacities, or 0 for floaters. [n]

    Faint members are not excluded: without them, tracks are less accurate (measured against true poses).

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
    """Return the radius of each group: the 90 % quantile of its voters' distances, 0 without members. [G]

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
            result[g] = observed_motion.radius(points[members], group.center)
    return result


def errors(path: np.ndarray, rows: np.ndarray, group: GroupTrack) -> np.ndarray:
    """Return the error of some Gaussians in one group. [n]

    Args:
        path: Centres at the knots. [R, S, 3]
        rows: Rows of the Gaussians. [n]
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
    """Return the group of each Gaussian after one round of regrouping.

    Args:
        path: Centres at the knots. [R, S, 3]
        ids: Their groups. [R]
        opacities: [R]
        groups: The groups, with poses relative to the last knot.

    Returns:
        Groups. [R] int64

    Source: own rule, with lengths as shares of a radius (docs/results/field.md). On ten fields of five
        scenes, halving or doubling any threshold but `NEAR` changes less than 0.1 dB; a sixth of this `NEAR` loses up
        to 0.9 dB.
    """
    sizes = radii(path[:, -1], ids, opacities, groups)
    own = np.zeros(len(path))
    for g, group in enumerate(groups):
        rows = np.flatnonzero(ids == g)
        own[rows] = errors(path, rows, group)
    best, chosen = np.full(len(path), np.inf), ids.astype(np.int64)
    for g, (group, size) in enumerate(zip(groups, sizes, strict=True)):
        rows = np.flatnonzero((ids != g) & (own > 0))
        # The pinned group has no radius, so that of the current group is used.
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
    """Return the caster of background Gaussians that imitate a shadow: they move along a plane below a moving body.

    Args:
        path: Centres at the knots. [R, S, 3]
        ids: Their groups; only those in group 0 are tested. [R]
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
        if alike.sum() < MIN_SHADOW_SIZE:
            continue
        slope = np.median(slopes[alike], axis=0)  # one light
        shift = group.displacements @ plane + np.outer(group.displacements @ normal, slope)
        shadow = dataclasses.replace(group, quats=rotations.identity(len(shift)), displacements=shift)
        found = errors(path, rows[asked], shadow)
        take = (found < BETTER * own[asked]) & (found < EXPLAINED * size) & (found < best[asked])
        if take.sum() >= MIN_SHADOW_SIZE:
            best[asked[take]], casters[rows[asked[take]]] = found[take], g
    return casters


def _alone(
    path: np.ndarray, rows: np.ndarray, leader: np.ndarray, plane: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit each Gaussian as a shadow with its own light: shift along the plane per rise [n, 3], and error [n].

    Args:
        path: Centres at the knots. [R, S, 3]
        rows: Rows of the Gaussians. [n]
        leader: Displacements of the caster. [S, 3]
        plane: Projection onto the plane. [3, 3]
        normal: Normal of the plane. [3]
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
    """Rows of the members that define a group's place: visible, and not floaters."""
    rows = np.flatnonzero(ids == group)
    return rows[(fit_weights(points[rows], opacities[rows]) > 0) & visibility.seen(opacities[rows])]


def _distances(points: np.ndarray, members: np.ndarray, limit: float) -> np.ndarray:
    """Return the distance of points from the nearest member, infinite beyond a limit. [n]"""
    if len(points) == 0 or len(members) == 0:
        return np.full(len(points), np.inf)
    return spatial.KDTree(members).query(points, distance_upper_bound=np.nextafter(limit, np.inf))[0]

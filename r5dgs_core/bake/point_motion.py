"""Motion of single Gaussians as a scene stores it: relative to the bind state and to what their groups do.

Notation: R Gaussians with states x_s at the knots s, last knot T. Their group takes the bind state x_T to
Q_s (x_T - p) + p + D_s; a residual is the change of the bind state that its group then brings to x_s.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..motion import rotations
from ..scene.scene import MotionGroup
from ..train.normalization import Normalization
from ..train.observed_motion import PointMotion

AT_ONCE = 8192  # Gaussians that are related to their groups at once; bounds memory
VISIBLE = 1e-4  # residuals below this share of the scene's size, and below this angle or log scale, are left out


def members(
    points: PointMotion,
    norm: Normalization,
    motion_ids: np.ndarray,
    track_poses: np.ndarray,
    pivots: np.ndarray,
    order: np.ndarray,
    extent: float,
) -> dict[str, Any]:
    """The fields of `Scene` that hold motion of single Gaussians.

    Args:
        points: States at the knots, training coordinates.
        norm: From training coordinates to the world.
        motion_ids: Group of each Gaussian, in the order of training. [N]
        track_poses: Poses of the groups at the knots, relative to the bind state. [G, S, 7]
        pivots: Points that they turn about, world. [G, 3]
        order: Row of training of each row of the scene. [N]
        extent: Size of the scene, world units.

    Returns:
        ``residual_rows``, ``residual_offsets``, ``residual_quats``, ``residual_log_scales``, ``dynamics`` and
        ``canonical_means``; None where a scene needs none.
    """
    result: dict[str, Any] = {}
    if points.dynamics is not None and np.any(points.dynamics):
        linear = np.repeat([norm.scale, 1.0, norm.scale, 1.0], 3)
        result["dynamics"] = (points.dynamics * linear)[order].astype(np.float32)
        if points.canonical is not None:
            result["canonical_means"] = norm.points_to_world(points.canonical)[order].astype(np.float32)
    rank = np.argsort(order)[points.rows]
    parts = []
    for chosen in np.array_split(np.argsort(rank), max(1, -(-len(rank) // AT_ONCE))):  # in the scene's order
        ids = motion_ids[points.rows[chosen]]
        offsets, turns, growths = _relative(points, chosen, norm, track_poses[ids], pivots[ids])
        seen = np.abs(offsets).max((1, 2), initial=0.0) > VISIBLE * extent
        seen |= np.abs(growths).max((1, 2), initial=0.0) > VISIBLE
        seen |= rotations.angle_between(turns, turns[:, -1:]).max(1, initial=0.0) > VISIBLE
        stored = (offsets[seen], turns[seen], growths[seen])
        parts.append((rank[chosen[seen]].astype(np.int32), *(part.astype(np.float32) for part in stored)))
    names = ("residual_rows", "residual_offsets", "residual_quats", "residual_log_scales")
    found = {name: np.concatenate(column) for name, column in zip(names, zip(*parts, strict=True), strict=True)}
    return result | found if len(found["residual_rows"]) else result


def _relative(
    points: PointMotion, chosen: np.ndarray, norm: Normalization, poses: np.ndarray, pivots: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals of some Gaussians: offsets [R, S, 3], rotations with continuous signs [R, S, 4], growths [R, S, 3].

    Args:
        points: States at the knots, training coordinates.
        chosen: Which of its rows. [R]
        norm: From training coordinates to the world.
        poses: Of their groups, relative to the bind state. [R, S, 7]
        pivots: Of their groups, world. [R, 3]
    """
    pivot, world = pivots[:, None], norm.points_to_world(points.means[chosen])
    back = rotations.conjugate(poses[..., :4])
    offsets = pivot + rotations.rotate(back, world - pivot - poses[..., 4:]) - world[:, -1:]
    quats = points.quats[chosen]
    turns = rotations.normalize(rotations.multiply(rotations.multiply(back, quats), rotations.conjugate(quats[:, -1:])))
    growths = points.log_scales[chosen] - points.log_scales[chosen][:, -1:]
    offsets[:, -1], growths[:, -1], turns[:, -1] = 0.0, 0.0, [1.0, 0, 0, 0]
    backwards = np.moveaxis(turns[:, ::-1], 1, 0)  # signs go on from the last knot, the identity
    return offsets, np.moveaxis(rotations.make_continuous(backwards), 0, 1)[:, ::-1], growths


def departures(
    groups: Sequence[MotionGroup], motion_ids: np.ndarray, rows: np.ndarray, offsets: np.ndarray
) -> list[MotionGroup]:
    """The groups with the distance that their members keep from rigid motion in the observed time.

    Args:
        groups: Motion groups.
        motion_ids: Group of each Gaussian of the scene. [N]
        rows: Those with residuals. [R]
        offsets: Their residual offsets. [R, S, 3]
    """
    squares, result = (offsets.astype(np.float64) ** 2).sum(-1), []
    for group in groups:
        mine = squares[motion_ids[rows] == group.id]
        count = max(1, int((motion_ids == group.id).sum()) * squares.shape[1])
        rms, largest = float(np.sqrt(mine.sum() / count)), float(np.sqrt(mine.max(initial=0.0)))
        result.append(dataclasses.replace(group, rigid_rms=rms, rigid_max=largest))
    return result

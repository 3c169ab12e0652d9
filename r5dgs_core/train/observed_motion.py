"""Observed motion of a trained representation, as passed to baking: motion groups with poses at the knots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GroupTrack:
    """Poses of one motion group at the knots, in training coordinates: x -> c + R (x - c) + d from the canonical state.

    Attributes:
        object_id: Object of the group; for a shadow, its caster.
        role: "pinned", "body" or "shadow".
        center: The fixed centre c. [3]
        quats: Rotations at the knots, unit wxyz. [S, 4]
        displacements: Displacements at the knots. [S, 3]
        observed: Knots at which the object was visible enough to be located. [S] bool
        follows: Group whose displacement it follows through ``follow_matrix``, or None.
        follow_matrix: Linear map from that group's displacement to its own. [3, 3]
        absent: Knots at which the object is not in the scene; None if there are none. [S] bool
    """

    object_id: int
    role: str
    center: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    observed: np.ndarray
    follows: int | None = None
    follow_matrix: np.ndarray | None = None
    absent: np.ndarray | None = None


@dataclass(frozen=True)
class PointMotion:
    """Motion of single Gaussians at the knots that their groups do not explain, in training coordinates.

    Attributes:
        rows: Rows of the Gaussians. [R]
        means: Centres. [R, S, 3]
        quats: Rotations, unit wxyz. [R, S, 4]
        log_scales: Log scales. [R, S, 3]
        dynamics: Velocity, angular velocity and their rates at the last knot, about each Gaussian's own centre, per
            unit of scene time. None if Gaussians have no dynamics of their own. [N, 12]
        canonical: Centres in the canonical state. [N, 3] or None
    """

    rows: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    dynamics: np.ndarray | None = None
    canonical: np.ndarray | None = None

    def keep(self, kept: np.ndarray) -> PointMotion:
        """Return the motion of the kept Gaussians only. [N] bool"""
        mine = kept[self.rows]
        rows = (np.cumsum(kept) - 1)[self.rows[mine]]
        dynamics = None if self.dynamics is None else self.dynamics[kept]
        canonical = None if self.canonical is None else self.canonical[kept]
        return PointMotion(rows, self.means[mine], self.quats[mine], self.log_scales[mine], dynamics, canonical)


@dataclass(frozen=True)
class RegroupCounts:
    """Counts of Gaussians that regrouping moved to another group.

    Attributes:
        to_bodies: Gaussians moved to another body.
        to_shadows: Gaussians moved to a shadow.
        to_rest: Gaussians that were found to be at rest.
        resting_shadows: Shadows that stayed at rest in the last observed times although their casters moved.
        moving: Number of moving Gaussians in total.
    """

    to_bodies: int = 0
    to_shadows: int = 0
    to_rest: int = 0
    resting_shadows: int = 0
    moving: int = 0

    @property
    def moved(self) -> int:
        """Number of Gaussians that changed their group."""
        return self.to_bodies + self.to_shadows + self.to_rest


@dataclass(frozen=True)
class ObservedMotion:
    """Observed motion of all Gaussians.

    Attributes:
        times: Knots. [S]
        groups: Motion groups by id.
        light: Light vector of the shading. [3]
        gaussians: Parameters by name that the tracks start from; None if they are the canonical ones.
        motion_ids: Group of each Gaussian; None if unchanged since training. [N]
        points: Motion of single Gaussians; None if all move with their groups.
        moves: Counts of regrouped Gaussians; None if regrouping did not run.
        smooth: True if tracks continue smoothly before their objects are first seen; otherwise they hold the first
            observed pose.
    """

    times: np.ndarray
    groups: tuple[GroupTrack, ...]
    light: np.ndarray
    gaussians: dict[str, np.ndarray] | None = None
    motion_ids: np.ndarray | None = None
    points: PointMotion | None = None
    smooth: bool = False
    moves: RegroupCounts | None = None


def radius(points: np.ndarray, center: np.ndarray) -> float:
    """Return the radius of a group, the 90 % quantile of its members' distances from a centre. [n, 3], n >= 1"""
    return float(np.quantile(np.linalg.norm(points - center, axis=1), 0.9))

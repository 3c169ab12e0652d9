"""Motion groups as a trained representation hands them to baking: poses at the knots, and what they belong to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GroupTrack:
    """One motion group over the knots, in training coordinates: x -> c + R (x - c) + d from the canonical state.

    Attributes:
        object_id: Object that it belongs to; a shadow's caster.
        role: "pinned", "body" or "shadow".
        center: The fixed centre c. [3]
        quats: Rotations at the knots, unit wxyz. [S, 4]
        displacements: Displacements at the knots. [S, 3]
        observed: Knots at which the object was seen well enough to be placed. [S] bool
        follows: Group whose displacement it takes through ``follow_matrix``, or None.
        follow_matrix: That map. [3, 3]
    """

    object_id: int
    role: str
    center: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    observed: np.ndarray
    follows: int | None = None
    follow_matrix: np.ndarray | None = None


@dataclass(frozen=True)
class PointMotion:
    """Motion of single Gaussians at the knots, in training coordinates; for what their groups do not explain.

    Attributes:
        rows: Which ones. [R]
        means: Their centres. [R, S, 3]
        quats: Their rotations, unit wxyz. [R, S, 4]
        log_scales: Their log scales. [R, S, 3]
        dynamics: Velocity, angular velocity and the rates of both at the last knot, about each Gaussian's own centre,
            per unit of scene time; None where Gaussians have no dynamics of their own. [N, 12]
        canonical: Centres in the canonical state. [N, 3] or None
    """

    rows: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    dynamics: np.ndarray | None = None
    canonical: np.ndarray | None = None

    def keep(self, kept: np.ndarray) -> PointMotion:
        """The same for the Gaussians that are kept. [N] bool"""
        mine = kept[self.rows]
        rows = (np.cumsum(kept) - 1)[self.rows[mine]]
        dynamics = None if self.dynamics is None else self.dynamics[kept]
        canonical = None if self.canonical is None else self.canonical[kept]
        return PointMotion(rows, self.means[mine], self.quats[mine], self.log_scales[mine], dynamics, canonical)


@dataclass(frozen=True)
class Moves:
    """What became of the Gaussians that move.

    Attributes:
        to_bodies: How many went to another body.
        to_shadows: How many went to a shadow.
        to_rest: How many were found to rest.
        resting_shadows: Shadows that stayed where they were in the last observed times though their casters moved.
        moving: Of how many.
    """

    to_bodies: int = 0
    to_shadows: int = 0
    to_rest: int = 0
    resting_shadows: int = 0
    moving: int = 0

    @property
    def moved(self) -> int:
        """How many changed their group."""
        return self.to_bodies + self.to_shadows + self.to_rest


@dataclass(frozen=True)
class ObservedMotion:
    """What a trained representation hands to baking.

    Attributes:
        times: Knots. [S]
        groups: Motion groups by id.
        light: Light of the shading. [3]
        gaussians: Parameters by name that the groups' tracks start from, where they are not the canonical ones.
        motion_ids: Group of each Gaussian, where it is not that of the training. [N]
        points: Motion of single Gaussians, or None where all move with their groups.
        moves: How many Gaussians went to groups that explain them better; None where none was asked.
        smooth: Whether the tracks go on smoothly before their objects are seen; else they hold the first observed pose.
    """

    times: np.ndarray
    groups: tuple[GroupTrack, ...]
    light: np.ndarray
    gaussians: dict[str, np.ndarray] | None = None
    motion_ids: np.ndarray | None = None
    points: PointMotion | None = None
    smooth: bool = False
    moves: Moves | None = None

"""The needs table: features that a scene needs, each with its measured value, threshold and decision.

``needs.NAME`` in the configuration is the user's override of a row; it takes precedence over the measurement in
training (`training_needs.resolve`) and in baking (`decide`, `simplify_motion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..config.sections import NeedsSection
from ..motion import rotations
from ..scene.scene import MotionGroup
from ..train.observed_motion import Moves

STILL_QUAT = rotations.identity()
STILL = 0.0025  # displacement in diameters of the group below which it is at rest, if the images are missing
TURN = 0.002  # rotation in radians that is negligible, if the images are missing
SHADING_LEVEL = 0.5 / 255  # change of colour that is invisible in an 8-bit image
SKY_BAND = 0.5 / 255  # sky coefficient that is invisible in an 8-bit image


def _travel(poses: np.ndarray, radius: float) -> float:
    """Return the largest displacement of a track, in diameters."""
    return float(np.linalg.norm(poses[:, 4:], axis=1).max()) / (2 * radius)


def _turn(poses: np.ndarray) -> float:
    """Return the largest rotation of a track, rad."""
    return float(rotations.angle_between(poses[:, :4], STILL_QUAT).max())


def is_on(table: Sequence[dict[str, Any]], name: str) -> bool:
    """True if the row ``name`` of the table is "on"."""
    return next(row["decision"] == "on" for row in table if row["name"] == name)


def decide(
    groups: Sequence[MotionGroup],
    track_poses: Sequence[np.ndarray] | np.ndarray,
    motion_ids: np.ndarray,
    shading: np.ndarray,
    light: np.ndarray,
    background_sh: np.ndarray,
    bases: int,
    classified: bool,
    wanted: NeedsSection | None = None,
    residuals: tuple[float, float, bool, str] = (0.0, 0.0, False, "none was tried"),
    moves: Moves | None = None,
) -> tuple[dict[str, Any], ...]:
    """Return the needs table of a baked scene.

    Args:
        groups: Motion groups.
        track_poses: Their tracks relative to the bind state, already simplified. G of [S, 7]
        motion_ids: Group of each Gaussian. [N]
        shading: Shading vectors in the bind state. [N, 3]
        light: Light direction. [3]
        background_sh: Sky coefficients that were kept. [Kb, 3]
        bases: Spherical harmonics bases of the colours.
        classified: True if identities and their classifier were trained.
        wanted: User's override of each row; None measures all.
        residuals: Value and threshold of the row "residuals", True if the scene has residuals, and the reason.
        moves: Gaussians that were moved to another group; None if regrouping did not run.

    Returns:
        Rows with name, value, threshold, decision ("on" or "off") and reason, which names the user's overrides. A
        feature that the run has not learned stays "off".
    """
    wanted = wanted or NeedsSection()
    bodies = [g for g in groups if g.role == "body"]
    largest_travel = max((_travel(track_poses[g.id], g.model.radius) for g in bodies), default=0.0)
    largest_turn = max((_turn(track_poses[g.id]) for g in bodies), default=0.0)
    moving = sum(bool(np.any(track_poses[g.id][:, 1:] != 0)) for g in bodies)
    change = float(np.abs(shading[motion_ids > 0]).max(initial=0.0) * np.linalg.norm(light) * largest_turn)
    shadow_members = int(sum((motion_ids == g.id).sum() for g in groups if g.role == "shadow"))
    sky, moved_over = len(background_sh), 0 if moves is None else moves.moved
    moved, turned = f"{moving} of {len(bodies)} objects move or turn", "largest turn in the observed time, rad"
    lit = bool(np.any(shading) and np.any(light))
    followers = "Gaussians that follow a caster on its support"
    # Name, value, threshold, True if needed, True if the run has learned it, meaning of the value.
    rows = [
        ("tracks", largest_travel, 0.0, moving > 0, len(bodies) > 0, moved),
        ("rotation", largest_turn, 0.0, largest_turn > 0, len(bodies) > 0, turned),
        ("shading", change, SHADING_LEVEL, change > SHADING_LEVEL, lit, "largest change of colour"),
        ("shadows", shadow_members, 1, shadow_members > 0, shadow_members > 0, followers),
        ("view_dependent_colour", bases, 2, bases > 1, bases > 1, "spherical harmonics bases"),
        ("sky_gradient", sky, 2, sky > 1, sky > 1, "spherical harmonics bases of the sky"),
        ("classifier", len(bodies), 1, classified, classified, "objects with masks"),
        ("residuals", residuals[0], residuals[1], residuals[2], residuals[2], residuals[3]),
        ("regrouping", moved_over, 1, moved_over > 0, moved_over > 0, _said(moves)),
    ]
    return tuple(
        _row(name, value, threshold, on, there, reason, getattr(wanted, name))
        for name, value, threshold, on, there, reason in rows
    )


def _said(moves: Moves | None) -> str:
    """Summary of the regrouping, for the reason of its row."""
    if moves is None:
        return "each Gaussian goes with the group that it was made for"
    said = (
        f"of {moves.moving} Gaussians that move, {moves.to_bodies} went to another body, {moves.to_shadows} to a "
        f"shadow, {moves.to_rest} to rest"
    )
    return said + (f"; {moves.resting_shadows} shadows rest" if moves.resting_shadows else "")


def _row(name: str, value: float, threshold: float, on: bool, there: bool, reason: str, wanted: str) -> dict[str, Any]:
    """Return a row of the table with the user's override applied."""
    if wanted != "auto":
        on = wanted == "on" and there
        missing = wanted == "on" and not there
        reason = f"set {wanted} by you{', but this run has none' if missing else ''}; {reason}"
    return row(name, value, threshold, on, reason)


def row(name: str, value: float, threshold: float, on: bool, reason: str) -> dict[str, Any]:
    """Return a row of the table."""
    return {
        "name": name,
        "value": float(value),
        "threshold": float(threshold),
        "decision": "on" if on else "off",
        "reason": reason,
    }

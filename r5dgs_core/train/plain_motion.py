"""What the motion of one object does not need: turns that are the noise of its track, bends of a straight path.

The selection of `motion.fitting` says what a track shows beyond its noise. Where that is no turn, or a straight path,
the object is stored so, if what is dropped is small and no larger than the noise. Notation: S poses.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..motion import candidates, fitting, rotations
from ..motion.models import MotionModel
from . import needs

WITHIN = 2.0  # noise levels that may be dropped
LIMIT = 0.01  # root mean square that may be dropped: displacements in diameters
TURN_LIMIT = 0.02  # the same for turns, rad


@dataclass(frozen=True)
class PlainMotion:
    """The motion of an object without what it does not need.

    Attributes:
        poses: Rotation wxyz and displacement relative to the bind state. [S, 7]
        shift: By which the bind state moves, as the last pose was off the plain path by noise. [3]
        model: Motion past t_max.
        rows: What was measured and decided, as rows of the needs table; none for what never moved.
    """

    poses: np.ndarray
    shift: np.ndarray
    model: MotionModel
    rows: tuple[dict[str, Any], ...]


def reduce(name: str, times: np.ndarray, poses: np.ndarray, fit: fitting.Fit) -> PlainMotion:
    """Drop the turn, the path or its bends where the track shows none.

    Args:
        name: Of the object, for the rows.
        times: Observed times, the last is t_max. [S]
        poses: Relative to the bind state. [S, 7]
        fit: What was chosen for the track.

    Returns:
        The plain motion. A body that came to rest keeps what it did before.
    """
    model, blocks = fit.model, set(candidates.BY_NAME[fit.chosen].blocks)
    poses, shift = poses.copy(), np.zeros(3)
    size = 2 * model.radius
    mean = rotations.normalize(rotations.make_continuous(poses[:, :4]).mean(0))
    turn = _spread(rotations.quats_to_rotvecs(rotations.multiply(poses[:, :4], rotations.conjugate(mean))))
    turn_allowed = min(WITHIN * fit.sigma_r, TURN_LIMIT)
    turns = fit.rested or bool(blocks & {"w", "swing"}) or turn > turn_allowed
    line = model.velocity * (times - times[-1])[:, None]
    bend = _spread(poses[:, 4:] - model.offset_displacement - line) / size
    bend_allowed = min(WITHIN * fit.sigma_t / size, LIMIT)
    bends = fit.rested or bool(blocks - {"v"}) or bend > bend_allowed
    if not turns:
        poses[:, :4] = rotations.identity()
        model = dataclasses.replace(model, offset_rotvec=np.zeros(3))
    if not bends:
        poses[:, 4:], shift = line, model.offset_displacement.copy()
        model = dataclasses.replace(model, offset_displacement=np.zeros(3))
    travel = float(np.linalg.norm(poses[:, 4:], axis=1).max()) / size
    chosen = f"came to rest, {fit.chosen}" if fit.rested else fit.chosen
    why = f"; goes with its motion, {chosen}" if bends and bend <= bend_allowed else ", likewise"
    rows = (
        needs.row("motion", travel, 0.0, travel > 0 or turns, f"largest displacement in diameters; {chosen}"),
        needs.row("rotation", turn, turn_allowed, turns, "spread of its turns, rad; threshold: that of noise"),
        needs.row("curved_path", bend, bend_allowed, bends, "distance from a straight path in diameters" + why),
    )
    return PlainMotion(poses, shift, model, tuple({"object": name, **row} for row in rows))


def _spread(vectors: np.ndarray) -> float:
    """Root mean square per component. [S, 3]"""
    return float(np.sqrt((vectors**2).mean()))

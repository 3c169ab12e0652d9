"""Poses of motion models at any time past t_max, one by one or many together."""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence

import numpy as np

from .. import rotations
from .base import Curve
from .motion_model import MotionModel
from .registry import KINDS

log = logging.getLogger(__name__)


def evaluate(model: MotionModel, tau: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the group relative to its bind state.

    Args:
        model: The motion.
        tau: Time since t_max, >= 0, any shape. [...]

    Returns:
        Unit quaternions wxyz [..., 4] and displacements of the pivot, world [..., 3], float64. tau = 0 gives exactly
        (1, 0, 0, 0) and 0. If a pose is not finite, the body stays at its pose at t_max, with a warning.
    """
    quats, displacements, _, _ = evaluate_with_rates(model, tau)
    return quats, displacements


def evaluate_all(models: Sequence[MotionModel], tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate G models at one time, vectorised over the models. For many times, keep a `MotionStack`.

    Returns:
        Unit quaternions wxyz [G, 4] and displacements [G, 3].
    """
    return MotionStack(models).poses(tau)


class MotionStack:
    """Several motions, evaluated together at any time. Time-independent quantities are precomputed."""

    def __init__(self, models: Sequence[MotionModel]):
        self._count = len(models)
        self._parts = []
        for name in sorted({model.kind for model in models}):
            rows = np.array([g for g, model in enumerate(models) if model.kind == name])
            poses = KINDS[name].stacked([models[g] for g in rows])
            if poses is not None:
                self._parts.append((rows, poses))
        self._faded = np.array(
            [g for g, m in enumerate(models) if m.offset_rotvec.any() or m.offset_displacement.any()]
        )
        fading = [models[g] for g in self._faded]
        self._fade_times = np.array([[model.fade_time] for model in fading])
        self._rotvecs = np.array([model.offset_rotvec for model in fading])
        self._displacements = np.array([model.offset_displacement for model in fading])

    def poses(self, tau: float) -> tuple[np.ndarray, np.ndarray]:
        """Unit quaternions wxyz [G, 4] and displacements [G, 3] at a time since t_max, as from `evaluate`."""
        if tau < 0:
            raise ValueError(f"tau: expected a time since t_max >= 0, got {tau}")
        quats, displacements = rotations.identity(self._count), np.zeros((self._count, 3))
        if tau == 0:
            return quats, displacements
        with np.errstate(over="ignore", invalid="ignore"):
            for rows, poses in self._parts:
                quats[rows], displacements[rows] = poses(float(tau))
            if len(self._faded):
                s = -np.expm1(-tau / self._fade_times)
                faded = rotations.rotvecs_to_quats(s * self._rotvecs)
                quats[self._faded] = rotations.multiply(quats[self._faded], faded)
                displacements[self._faded] += s * self._displacements
        held = _held(quats, displacements)
        return held[0], held[1]


def _held(*parts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Replace poses and rates that are not finite by those of a body at rest."""
    sound = np.all([np.isfinite(part).all(-1) for part in parts], axis=0)
    if sound.all():
        return parts
    _warn_of_wild_motion()
    still = (rotations.identity(), *([np.zeros(3)] * (len(parts) - 1)))
    return tuple(np.where(np.expand_dims(sound, -1), part, rest) for part, rest in zip(parts, still, strict=True))


@functools.cache
def _warn_of_wild_motion() -> None:
    log.warning(
        "a motion model gives poses that are not finite; its body stays at its pose at t_max. Remedy: an earlier time "
        "or smaller rates"
    )


def evaluate_with_rates(model: MotionModel, tau: float | np.ndarray, most_steps: int | None = None) -> Curve:
    """Pose as from `evaluate`, with its exact time derivative.

    Args:
        model: The motion.
        tau: Time since t_max, >= 0, any shape. [...]
        most_steps: Maximum number of integration steps for all times together, or None for no limit. If more are
            needed, times share steps; if that does not suffice, poses are rigid but inaccurate.

    Returns:
        Quaternions [..., 4], displacements [..., 3], angular velocities in the world frame, rad per unit [..., 3], and
        velocities of the pivot [..., 3].
    """
    tau = np.asarray(tau, np.float64)
    if (tau < 0).any():
        raise ValueError(f"tau: expected times since t_max >= 0, got {tau.min()}")
    with np.errstate(over="ignore", invalid="ignore"):
        quats, displacements, spins, velocities = curve(model, tau, most_steps)
        s = -np.expm1(-tau / model.fade_time)[..., None]
        rate = (1 - s) / model.fade_time
        blended = rotations.multiply(quats, rotations.rotvecs_to_quats(s * model.offset_rotvec))
        held = _held(
            blended,
            displacements + s * model.offset_displacement,
            spins + rate * rotations.rotate(quats, np.broadcast_to(model.offset_rotvec, spins.shape)),
            velocities + rate * model.offset_displacement,
        )
    return held[0], held[1], held[2], held[3]


def curve(model: MotionModel, tau: float | np.ndarray, most_steps: int | None = None) -> Curve:
    """The fitted curve (R_f, d_f) without offsets, the identity at tau = 0, with its exact derivative.

    Args:
        model: The motion.
        tau: Time since t_max, of either sign, any shape. [...]
        most_steps: As in `evaluate_with_rates`, for times >= 0.

    Returns:
        As `evaluate_with_rates`.
    """
    return KINDS[model.kind].curve(model, np.asarray(tau, np.float64), most_steps)


def kinks(model: MotionModel, end: float) -> np.ndarray:
    """Times since t_max, in (0, end], at which the velocity or the acceleration jumps, increasing. [K]"""
    return KINDS[model.kind].kinks(model, end)


def steps_needed(model: MotionModel, tau: np.ndarray) -> np.ndarray:
    """Number of integration steps for each pose; 1 for kinds with a closed form. [S] -> [S]"""
    return KINDS[model.kind].steps_needed(model, tau)

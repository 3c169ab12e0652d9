"""A twist in the world whose rates are linear in time, by Magnus-4 steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .. import rotations, se3, twist_propagation
from .base import Curve, MotionModel, Rates
from .twist import Twist

_STEP_TOLERANCE = 1e-9  # allowed Magnus-4 error, in radii
_MAX_STEPS = 1 << 20  # maximum number of Magnus steps to one time
_FIT_STEPS = 16  # number of Magnus steps per time when candidates are compared


class WorldTwist(Twist):
    """v(x) = v + w x (x - p) with v and w linear in time and x in the world.

    It is not fitted by default: it cannot describe a falling body that spins, because the rate of its centre would be
    quadratic in time, and other candidates describe the hinges and screws that it can describe.
    """

    label = "Orbit"
    tooltip = "Turns about a point in the world, with constant acceleration"
    word = "orbit"
    fields = ("velocity", "acceleration", "angular_velocity", "angular_acceleration")
    fits = {"world twist": ("v", "a", "w", "eps")}
    fits_by_default = False

    def curve(self, model: MotionModel, tau: np.ndarray, most_steps: int | None) -> Curve:
        quats, d = _poses(model, tau, most_steps)
        span = tau[..., None]
        spins = model.angular_velocity + model.angular_acceleration * span
        return quats, d, spins, model.velocity + model.acceleration * span + rotations.cross(spins, d)

    def stacked(self, models: Sequence[MotionModel]) -> Callable[[float], se3.Pose]:
        rates = Rates.of(models)
        radii = np.array([model.radius for model in models])
        return twist_propagation.Propagator(
            np.concatenate([rates.v, rates.w, rates.a, rates.eps], -1), _STEP_TOLERANCE * radii, radii, _MAX_STEPS
        ).rows_of

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        """Poses for comparing candidates, from a fixed number of steps."""
        h = span / _FIT_STEPS
        middles = np.arange(_FIT_STEPS)[:, None, None, None] + 0.5
        mw, mv = rates.w + middles * h * rates.eps, rates.v + middles * h * rates.a
        bracket = (rotations.cross(mw, rates.eps), rotations.cross(mw, rates.a) - rotations.cross(rates.eps, mv))
        return se3.product(*se3.exp(h * mw - h**3 / 12 * bracket[0], h * mv - h**3 / 12 * bracket[1]))

    def steps_needed(self, model: MotionModel, tau: np.ndarray) -> np.ndarray:
        v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
        return se3.steps_needed(w, v, eps, a, tau, model.radius, _STEP_TOLERANCE * model.radius)


KIND = WorldTwist()


def _poses(model: MotionModel, tau: np.ndarray, most_steps: int | None) -> se3.Pose:
    """Magnus-4 poses, each time with its own number of steps rounded up to a power of two.

    Poses are NaN at times for which no number of steps meets the tolerance.
    """
    v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
    flat = tau.reshape(-1)
    needed = KIND.steps_needed(model, flat)
    steps = np.minimum(1 << np.ceil(np.log2(needed)).astype(np.int64), _MAX_STEPS)
    quats, displacements = rotations.identity(len(flat)), np.zeros((len(flat), 3))
    hopeless = needed >= se3.MAX_STEPS
    quats[hopeless] = np.nan
    if most_steps is not None and steps[~hopeless].sum() > most_steps:
        quats[~hopeless], displacements[~hopeless] = _shared_steps(
            model, flat[~hopeless], needed[~hopeless], most_steps
        )
        return quats.reshape(*tau.shape, 4), displacements.reshape(*tau.shape, 3)
    for n in np.unique(steps[~hopeless]):
        rows = np.flatnonzero((steps == n) & ~hopeless)
        for block in np.array_split(rows, max(1, len(rows) * int(n) >> 18)):
            quats[block], displacements[block] = se3.integrate(w, v, eps, a, flat[block], int(n))
    return quats.reshape(*tau.shape, 4), displacements.reshape(*tau.shape, 3)


def _shared_steps(model: MotionModel, taus: np.ndarray, needed: np.ndarray, most: int) -> se3.Pose:
    """Magnus-4 poses at times >= 0, each integrated from the previous one: [S] -> [S, 4], [S, 3].

    All intervals between times take the same number of steps: enough for the shortest step length that any time needs,
    or as many as ``most`` allows.
    """
    v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
    times, rows = np.unique(taus, return_inverse=True)
    starts = np.concatenate([[0.0], times[:-1]])
    gaps = times - starts
    shortest = float((taus / needed)[needed.argmax()])
    steps = int(min(max(1.0, np.ceil(gaps.max() / shortest)), max(1, most // len(times))))
    w_start, v_start = w + starts[:, None] * eps, v + starts[:, None] * a
    parts = [
        se3.integrate(w_start[block], v_start[block], eps, a, gaps[block], steps)
        for block in np.array_split(np.arange(len(times)), 1 + (len(times) * steps >> 18))
    ]
    quats, displacements = se3.scan(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return rotations.normalize(quats)[rows], displacements[rows]

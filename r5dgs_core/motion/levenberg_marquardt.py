"""Nonlinear least squares by Levenberg-Marquardt, for one start or many at once, optionally robust against outliers.

The residuals of all parameter vectors that a step needs are evaluated in one call, since for small problems the number
of numpy calls sets the run time. Notation: P parameters x, S observations of D components each, B starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from . import robust_weights

_DIFFERENCE = 1e-6
_FIRST_DAMPING = 1e-4
_MIN_DAMPING, _MAX_DAMPING = 1e-10, 1e10
_TOLERANCE = 1e-5  # predicted gain / cost at which iteration ends
_TRIAL_STEPS = 2  # number of steps before a hopeless start may end
_STALLING = 0.05  # share of the weighted squared residuals that a step of a hopeless start must remove
_NEGLIGIBLE_GAIN = 1e-20  # absolute predicted gain at which iteration ends, for costs near zero


@dataclass(frozen=True)
class Solution:
    """Minima of B starts; without the leading axis if there is one start.

    Attributes:
        x: Parameters. [B, P]
        residuals: Residuals without weights. [B, S, D]
        robust: Robust weights of the observations, in (0, 1]; 1 for least squares. [B, S]
        normal: Normal matrix J^T W J of the weighted residuals plus the precision of the prior. [B, P, P]
        gradient: Gradient of half the cost. [B, P]
        cost: Weighted sum of squared residuals, or of their Cauchy losses, plus the cost of the prior. [B]
    """

    x: np.ndarray
    residuals: np.ndarray
    robust: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    cost: np.ndarray

    def row(self, index: int) -> Solution:
        """Minimum of one start."""
        return Solution(*(getattr(self, field.name)[index] for field in fields(self)))


def solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    **options: Any,
) -> Solution:
    """Minimise a sum of squared residuals from one start.

    Args:
        residuals: Function from parameters [B, P] to residuals [B, S, D].
        start: Initial guess, with finite residuals. [P]
        options: Those of `solve_all`.
    """
    return solve_all(lambda x, _: residuals(x[0])[None], start[None], **options).row(0)


Linearized = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function from parameters [L, P] and the starts [L] that they belong to, to residuals and derivatives."""


def solve_all(
    residuals: Callable[[np.ndarray, np.ndarray], np.ndarray], starts: np.ndarray, **options: Any
) -> Solution:
    """Minimise weighted sums of squared residuals from several starts, with forward differences.

    Args:
        residuals: Function from parameters [L, K, P] and the starts [L] that they belong to, to residuals
            [L, K, S, D]. Each step calls it once, with P + 1 parameter vectors per start.
        starts: Initial guesses, with finite residuals. [B, P]
        options: Those of `solve_linearized`.
    """
    nudges = _DIFFERENCE * np.eye(starts.shape[1] + 1, starts.shape[1], -1)

    def linearized(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        batch = residuals(x[:, None] + nudges, rows)
        return batch[:, 0], (batch[:, 1:] - batch[:, :1]) / _DIFFERENCE

    return solve_linearized(linearized, starts, **options)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def solve_linearized(
    linearized: Linearized,
    starts: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    precision: np.ndarray | None = None,
    softness: float = np.inf,
    steps: int = 40,
    enough: float = _NEGLIGIBLE_GAIN,
    hopeless: float = np.inf,
    behind: float = np.inf,
) -> Solution:
    """Minimise weighted sums of squared residuals from several starts, whose problems may differ.

    Args:
        linearized: Function from parameters [L, P] and the starts [L] that they belong to, to residuals [L, S, D] and
            their derivatives [L, P, S, D]. Parameters and residuals should be of order one, residuals in units of their
            noise. Steps to residuals that are not finite are rejected.
        starts: Initial guesses, with finite residuals. [B, P]
        weights: Weights of the observations, > 0, or None for equal ones. [S]
        precision: Inverse standard deviations of the parameters about 0, for a Gaussian prior; None for no prior. [P]
        softness: Squared length of the residuals of an observation at which its weight is one half; infinite for least
            squares.
        steps: Maximum number of steps. Each calls ``linearized`` once.
        enough: Predicted gain below which a start is finished.
        hopeless: Cost above which a start is also finished if its next step would hardly reduce the residuals.
        behind: The same, as excess over the cost of the best start.

    Source: Marquardt 1963, with damping relative to the diagonal of the normal matrix. The damping follows the ratio of
        actual to predicted gain (Nielsen 1999). Robust fits reweight inside each step, with Cauchy weights.
    """
    count, size = starts.shape
    base = np.ones(1) if weights is None else weights
    prior = np.zeros(size) if precision is None else precision**2
    problem = _Problem(base, prior, softness)
    point = problem.expand(starts, *linearized(starts, np.arange(count)))
    damping, growth, live = np.full(count, _FIRST_DAMPING), np.full(count, 2.0), np.arange(count)
    for number in range(steps):
        step, gain = _damped_step(point, live, damping)
        moving = (gain > _TOLERANCE * point.cost[live] + enough) & np.isfinite(gain)
        if number >= _TRIAL_STEPS:
            moving &= ~problem.stalls(point, live, gain, min(hopeless, float(np.min(point.cost)) + behind))
        live, step, gain = live[moving], step[moving], gain[moving]
        if len(live) == 0:
            break
        x = point.x[live] + step
        trial = problem.expand(x, *linearized(x, live))
        ratio = (point.cost[live] - trial.cost) / gain
        better = (ratio >= 0) & np.isfinite(trial.normal).all((1, 2)) & np.isfinite(trial.gradient).all(1)
        good = live[better]
        for field in fields(Solution):
            getattr(point, field.name)[good] = getattr(trial, field.name)[better]
        shrink = np.maximum(0.1, 1 - (2 * np.clip(ratio[better], 0, 1) - 1) ** 3)
        damping[good], growth[good] = np.maximum(damping[good] * shrink, _MIN_DAMPING), 2.0
        bad = live[~better]
        damping[bad], growth[bad] = damping[bad] * growth[bad], 2 * growth[bad]
        live = live[damping[live] < _MAX_DAMPING]
    return point


def _damped_step(point: Solution, live: np.ndarray, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the live starts, and the gains that they would have if the residuals were linear. [L, P], [L]"""
    normal, gradient = point.normal[live], point.gradient[live]
    diagonal = np.einsum("bii->bi", normal)
    diagonal = diagonal + 1e-12 * diagonal.sum(1, keepdims=True) + np.finfo(float).tiny
    damped = damping[live, None] * diagonal
    identity = np.eye(normal.shape[-1])
    step = -np.linalg.solve(normal + damped[:, :, None] * identity, gradient[..., None])[..., 0]
    return step, (step * (damped * step - gradient)).sum(1)


@dataclass(frozen=True)
class _Problem:
    """Weights, prior and loss of `solve_all`."""

    base: np.ndarray
    prior: np.ndarray
    softness: float

    def stalls(self, point: Solution, live: np.ndarray, gain: np.ndarray, limit: float) -> np.ndarray:
        """Starts that cost more than a limit and whose next step hardly reduces their residuals. [L]"""
        if not np.isfinite(limit):
            return np.zeros(len(live), bool)
        squares = (self.base * point.robust[live] * (point.residuals[live] ** 2).sum(-1)).sum(-1)
        return (point.cost[live] > limit) & (gain < _STALLING * squares)

    def expand(self, x: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> Solution:
        """Normal equations at x [B, P] from the residuals [B, S, D] there and their derivatives [B, P, S, D]."""
        squares = (values**2).sum(-1)
        robust = robust_weights.cauchy_weights(squares, self.softness)
        losses = robust_weights.cauchy_losses(squares, self.softness)
        root = np.sqrt(self.base * robust)[..., None]
        jacobian = (slopes * root[:, None]).reshape(*x.shape, -1)
        weighted = (root * values).reshape(len(x), -1, 1)
        return Solution(
            x.copy(),
            values.copy(),
            robust,
            normal=jacobian @ jacobian.swapaxes(1, 2) + np.diag(self.prior),
            gradient=(jacobian @ weighted)[..., 0] + self.prior * x,
            cost=(self.base * losses).sum(-1) + (self.prior * x**2).sum(-1),
        )

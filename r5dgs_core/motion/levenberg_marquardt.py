"""Nonlinear least squares by Levenberg-Marquardt, optionally robust against outlying observations.

The residuals of all parameter vectors that a step needs are evaluated in one call, since for small problems the number
of numpy calls sets the run time. Notation: P parameters x, S observations of D components each, B parameter vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import robust_weights

_DIFFERENCE = 1e-6
_FIRST_DAMPING = 1e-4
_LEAST_DAMPING, _MOST_DAMPING = 1e-10, 1e10
_TOLERANCE = 1e-5  # predicted gain / cost at which iteration ends
_COARSE = 1e-2  # the same, below which outliers are detected
_NEGLIGIBLE_GAIN = 1e-20  # predicted gain at which iteration ends even if the cost is less
_LEAST_OUTLIER = 1e-6  # smallest residual that can be an outlier


@dataclass(frozen=True)
class Solution:
    """A minimum.

    Attributes:
        x: Parameters. [P]
        residuals: Residuals without weights. [S, D]
        robust: Robust weights of the observations, in (0, 1]; 1 if there are no outliers. [S]
        normal: Normal matrix J^T W J of the weighted residuals plus the precision of the prior. [P, P]
        gradient: Gradient of half the cost. [P]
        cost: Weighted sum of squared residuals, or of their Cauchy losses, plus the cost of the prior.
        scale: Scale of the Cauchy loss; infinite without robust weights.
    """

    x: np.ndarray
    residuals: np.ndarray
    robust: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    cost: float
    scale: float


@np.errstate(over="ignore", invalid="ignore")
def solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    precision: np.ndarray | None = None,
    robust: bool = False,
    steps: int = 40,
) -> Solution:
    """Minimise a weighted sum of squared residuals.

    Args:
        residuals: Function from parameters [B, P] to residuals [B, S, D]. Both should be of order one, residuals in
            units of their noise. Steps to residuals that are not finite are refused.
        start: Initial guess, with finite residuals. [P]
        weights: Weights of the observations, > 0, or None for equal ones. [S]
        precision: Inverse standard deviations of the parameters about 0, for a Gaussian prior; None for no prior. [P]
        robust: True to reduce the weights of outlying observations.
        steps: Largest number of steps. Each calls ``residuals`` once, with P + 1 parameter vectors.

    Source: Marquardt 1963, with damping relative to the diagonal of the normal matrix and forward differences. The
        damping follows the ratio of actual to predicted gain (Nielsen 1999). Robust fits reweight inside each step:
        once the plain fit is close and has outliers, observations get Cauchy weights with a scale from the median.
    """
    base = np.ones(1) if weights is None else weights
    prior = np.zeros(len(start)) if precision is None else precision**2
    nudges = _DIFFERENCE * np.eye(len(start) + 1, len(start), -1)
    damping, growth, reweighted = _FIRST_DAMPING, 2.0, False
    batch = residuals(start + nudges)
    point = _linearize(start, batch, base, prior, reweighted)
    for _ in range(steps):
        diagonal = np.diag(point.normal) + 1e-12 * np.trace(point.normal) + np.finfo(float).tiny
        step = -np.linalg.solve(point.normal + np.diag(damping * diagonal), point.gradient)
        gain = float(step @ (damping * diagonal * step - point.gradient))  # if the residuals were linear
        if robust and not reweighted and gain <= _COARSE * point.cost:
            reweighted = robust_weights.has_outliers(_sizes(point.residuals), _LEAST_OUTLIER)
            if reweighted:
                point = _linearize(point.x, batch, base, prior, reweighted)
                continue
        if gain <= _TOLERANCE * point.cost + _NEGLIGIBLE_GAIN:
            break
        x = point.x + step
        trial = residuals(x + nudges)
        ratio = (point.cost - _cost(trial[0], x, base, prior, point.scale)) / gain
        if ratio >= 0 and np.isfinite(trial).all():
            batch, damping = trial, max(damping * max(0.1, 1 - (2 * ratio - 1) ** 3), _LEAST_DAMPING)
            point, growth = _linearize(x, batch, base, prior, reweighted), 2.0
        elif damping < _MOST_DAMPING:
            damping, growth = damping * growth, 2 * growth
        else:
            break
    return point


def _linearize(x: np.ndarray, batch: np.ndarray, base: np.ndarray, prior: np.ndarray, reweighted: bool) -> Solution:
    """Normal equations at x from the residuals there and at the neighbours of `solve`. batch: [P + 1, S, D]"""
    values = batch[0]
    scale = robust_weights.cauchy_scale(_sizes(values), _LEAST_OUTLIER) if reweighted else np.inf
    robust = robust_weights.reweight(np.ones(len(values)), _sizes(values), scale)
    root = np.sqrt(base * robust)[:, None]
    jacobian = ((batch[1:] - values) / _DIFFERENCE * root).reshape(len(x), -1)
    return Solution(
        x,
        values,
        robust,
        normal=jacobian @ jacobian.T + np.diag(prior),
        gradient=jacobian @ (root * values).reshape(-1) + prior * x,
        cost=_cost(values, x, base, prior, scale),
        scale=scale,
    )


def _cost(values: np.ndarray, x: np.ndarray, base: np.ndarray, prior: np.ndarray, scale: float) -> float:
    """Weighted sum of squares, or of Cauchy losses scale^2 log(1 + size^2 / scale^2), and the cost of the prior."""
    squares = (values**2).sum(-1)
    losses = squares if np.isinf(scale) else scale**2 * np.log1p(squares / scale**2)
    return float((base * losses).sum() + (prior * x**2).sum())


def _sizes(values: np.ndarray) -> np.ndarray:
    """Lengths of the residuals of each observation. [S, D] -> [S]"""
    return np.sqrt((values**2).sum(-1))

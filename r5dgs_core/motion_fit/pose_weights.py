"""Weights, noise and drift of a track from the standard deviations of its poses.

Notation: S poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..motion.history import PoseErrors, with_bend

# Share of the usual errors of the poses below which laws do not differ (docs/results/predicted_motion.md).
SCATTER = 0.75
EXACT = 1e-6  # error that cannot be distinguished from zero, rad or radii


@dataclass(frozen=True)
class PoseWeights:
    """Arguments of `model_selection.fit` for a track whose poses have known errors.

    Attributes:
        weights: Weights of the poses, at most 1. [S]
        noise: Lower bounds of the noise of displacements, world units, and of rotations, rad: laws must not follow
            errors that change slowly.
        drift: Drift of displacements, world units, and of rotations, rad.
    """

    weights: np.ndarray
    noise: tuple[float, float] = (0.0, 0.0)
    drift: tuple[float, float] = (0.0, 0.0)


def from_errors(
    errors: PoseErrors | None, observed: np.ndarray, radius: float, turns: bool, bend: float = 0.0
) -> PoseWeights:
    """Return the weights of the poses of a track, 1 for the usual ones and less for those with larger errors.

    Args:
        errors: Errors of the poses; None if they are not known.
        observed: Poses to use; others get the weight 0. [S] bool
        radius: Radius of the body, world units.
        turns: False if its rotations are not used.
        bend: Root mean square distance of the body's Gaussians from its rigid motion, world units. A body that bends
            has no exact pose, so this counts as drift.
    """
    weights, usual = observed.astype(np.float64), (0.0, 0.0)
    if errors is not None:
        weights, usual = _weights(errors, observed, radius, turns), _usual(errors, observed)
    place, turn = with_bend(np.array(usual), radius, bend)
    noise = SCATTER * usual[0], SCATTER * usual[1]
    return PoseWeights(weights, noise, (float(place), float(turn) if turns else 0.0))


def _weights(errors: PoseErrors, observed: np.ndarray, radius: float, turns: bool) -> np.ndarray:
    variances = (np.array(errors.place) / radius) ** 2
    if turns:
        variances = variances + 2 / 3 * np.array(errors.turn) ** 2
    variances = np.maximum(variances, EXACT**2)
    used = observed & np.isfinite(variances)
    if not used.any():
        return observed.astype(np.float64)
    share = np.where(used, variances, np.inf) / float(np.median(variances[used]))
    return np.minimum(2 / (1 + share), 1.0)


def _usual(errors: PoseErrors, observed: np.ndarray) -> tuple[float, float]:
    """Median errors of displacements and of rotations, each of its finite ones; zero if there are none."""
    place, turn = (np.array(values)[observed & np.isfinite(values)] for values in (errors.place, errors.turn))
    return _median(place), _median(turn)


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else 0.0

"""Confidence band of a predicted motion, and the time up to which it can be trusted.

The variance of a point of the body comes from the covariance of the parameters and from the distance to other
candidates, each weighted by its plausibility, and from what the law leaves out. Notation: H times past t_max; variances
are in squared radii.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import rotations, se3
from ..motion.history import MAX_KNOTS, Band
from . import backtest, law_errors
from . import candidates as families
from .candidates import FittedCandidate, Noise
from .fitted_motion import fade_time
from .model_scores import NoiseLevel
from .search import Selected

LEVEL = 0.95
WIDE = 0.4  # half width above which a motion is not predictable, in radii
_SOON = 1 / 3  # time past t_max, in spans
_MULTIPLE = 1.4  # half width at `LEVEL` / standard deviation, calibrated on simulated motions
_DRIFT = 5.0  # drift of a track over its span, in units of the lower bound of its noise
_LINE = math.sqrt(12.0)  # drift at a constant rate over the span, in standard deviations
_SOFT = 3.5  # difference of losses that reduces a candidate's weight by e
_OUTLIER = families.SOFTNESS  # maximum loss of a pose in this difference
_FARTHEST = 8.0  # maximum counted distance of another candidate, in radii
_LATER = 5  # number of the knots past the first span, of a body that enters late
_MAX_SCALE = 36.0  # maximum factor on the covariance from the errors of earlier predictions


def drift_noise(least: Noise, deviations: Noise) -> Noise:
    """Drift of a track over its span, from the lower bound of its noise and standard deviations due to drift."""
    return Noise(
        max(_DRIFT * least.place, _LINE * deviations.place),
        max(_DRIFT * least.turn, _LINE * deviations.turn),
    )


def confidence_band(selected: Selected, variance: float, drift: Noise, until: float = 1.0) -> Widths:
    """Band of the chosen solution.

    Args:
        selected: Result of the selection.
        variance: Factor of the parameters' covariance, from `model_scores.covariance_factor`.
        drift: Drift of the track over its span.
        until: End of the band, spans past t_max.
    """
    tau = _knots(until)
    chosen, noise_level, noise = selected.chosen, selected.noise_level, selected.noise
    place, turn = _variance(chosen, variance, tau)
    place2, turn2 = _spread(chosen, selected.solutions, noise_level, tau)
    bent, bent_turn = law_errors.squares(chosen, selected.track, noise, tau)
    fading = np.exp(-2 * tau / fade_time(chosen))  # of the bind state, which is a noisy pose
    last = noise_level.level * fading
    scale = min(max(backtest.relative_error(chosen, selected.track, noise, variance), 1.0), _MAX_SCALE)
    growth = 3 * (0.5 + tau) ** 2
    turn = scale * turn + turn2 + bent_turn + 3 * noise.turn**2 * last + growth * drift.turn**2
    place = scale * place + place2 + bent + 3 * noise.place**2 * last + growth * drift.place**2
    width = _MULTIPLE * np.sqrt(place + 2 / 3 * turn)
    wide = np.flatnonzero(width > WIDE)
    return Widths(tau, width, _MULTIPLE * np.sqrt(turn), _crossing(tau, width, int(wide[0])) if len(wide) else None)


def _knots(until: float) -> np.ndarray:
    """Times of the knots since t_max, spans: evenly spread over one span, and ever wider apart up to ``until``. [H]"""
    if until <= 1:
        return np.linspace(0.0, 1.0, MAX_KNOTS)
    return np.concatenate([np.linspace(0.0, 1.0, MAX_KNOTS - _LATER), np.geomspace(1.0, until, _LATER + 1)[1:]])


@dataclass(frozen=True)
class Widths:
    """Confidence band in radii and spans.

    Attributes:
        tau: Times since t_max. [H]
        half_width: Half width of the position of a point of the body. [H]
        half_angle: Half width of the rotation, rad. [H]
        trusted: Time since t_max up to which the motion is predictable; None if up to the last one.
    """

    tau: np.ndarray
    half_width: np.ndarray
    half_angle: np.ndarray
    trusted: float | None

    @property
    def unknown(self) -> bool:
        """True if the half width soon exceeds the body's size, so that no law predicts the motion."""
        return float(np.interp(_SOON, self.tau, self.half_width)) > 2.0

    def scaled(self, t_max: float, radius: float, span: float) -> Band:
        """Band in scene times and world units."""
        return Band(
            tuple((t_max + span * self.tau).tolist()),
            tuple((radius * self.half_width).tolist()),
            tuple(np.minimum(self.half_angle, math.pi).tolist()),
            LEVEL,
            None if self.trusted is None else t_max + span * self.trusted,
        )


def trusted(band: Band, radius: float) -> Band:
    """Return a band with the time at which its half width becomes too large for a body of the given radius."""
    widths = np.array(band.half_width) / radius
    wide = np.flatnonzero(widths > WIDE)
    until = _crossing(np.array(band.times), widths, int(wide[0])) if len(wide) else None
    return replace(band, predictable_until=until)


def of_unknown_motion(t_max: float, span: float, radius: float) -> Band:
    """Return the band of a body with fewer than two poses, whose motion is unknown."""
    width = _FARTHEST * radius
    return Band((t_max, t_max + span), (width, width), (math.pi, math.pi), LEVEL, t_max)


def _crossing(tau: np.ndarray, values: np.ndarray, row: int) -> float:
    """Time at which linear interpolation reaches `WIDE`, in the interval before a row."""
    if row == 0:
        return float(tau[0])
    share = (WIDE - values[row - 1]) / (values[row] - values[row - 1])
    return float(tau[row - 1] + share * (tau[row] - tau[row - 1]))


def _poses(solution: FittedCandidate, tau: np.ndarray) -> se3.Pose:
    return solution.candidate.law.path(solution.law_theta, tau)


def _variance(solution: FittedCandidate, variance: float, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variance of the position and of the rotation vector, summed over components, from the covariance. [H]"""
    law, theta = solution.candidate.law, solution.law_theta
    quats, d = law.path(theta, tau)
    step = 1e-5
    moved_quats, moved = law.poses(theta + step * np.eye(len(theta)), tau)
    turns = rotations.quats_to_rotvecs(rotations.multiply(moved_quats, rotations.conjugate(quats)))
    slopes = np.concatenate([moved - d, turns], axis=-1) / step  # [P', H, 6]
    covariance = solution.law_slopes @ solution.inverse @ solution.law_slopes.T
    spread = variance * np.einsum("phc,pq,qhc->hc", slopes, covariance, slopes)
    return np.maximum(spread[:, :3].sum(-1), 0.0), np.clip(spread[:, 3:].sum(-1), 0.0, math.pi**2)


def _spread(
    chosen: FittedCandidate, all_solutions: Sequence[FittedCandidate], noise_level: NoiseLevel, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean squared distances of other candidates' positions and rotations from the chosen one's, by plausibility. [H]

    Two rules keep laws in the band that the scores, which choose a law, exclude too surely. Parameters have the cost of
    Akaike's criterion for few data, which does not grow with the number of poses, because few poses may show a
    parameter, such as a rate after a break. The loss of a pose is limited, because one pose does not tell an outlier
    from an impact. Events at any of the poses cost as much for laws that contain them as for breaks.

    Source: Hurvich and Tsai 1989 for the cost.
    """
    losses = np.stack([s.losses for s in all_solutions]) / noise_level.variance
    count, parameters = 6 * losses.shape[1], np.array([s.parameters for s in all_solutions])
    costs = np.minimum(losses, _OUTLIER).sum(1) + 2 * parameters * count / np.maximum(count - parameters - 1, 1)
    costs += 2 * math.log(losses.shape[1]) * np.array([bool(s.candidate.events(s.theta)) for s in all_solutions])
    weights = np.exp(-(costs - costs.min()) / _SOFT)
    weights = np.where(weights < math.exp(-6.0), 0.0, weights)
    index = next(i for i, s in enumerate(all_solutions) if s is chosen)
    weights[index] = max(weights[index], 0.5)
    weights /= weights.sum()
    quats, d = _poses(chosen, tau)
    place, turn = np.zeros(len(tau)), np.zeros(len(tau))
    for weight, other in zip(weights, all_solutions, strict=True):
        if other is chosen or weight == 0:
            continue
        other_quats, other_d = _poses(other, tau)
        angle = rotations.angle_between(other_quats, quats)
        place += weight * np.minimum(((other_d - d) ** 2).sum(-1), _FARTHEST**2)
        turn += weight * angle**2
    return place, turn

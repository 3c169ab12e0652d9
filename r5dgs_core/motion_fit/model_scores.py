"""Scores of candidate motions: one score for laws with and without breaks.

The score B of a candidate is its Cauchy loss in units of the noise level s2 of the best candidate, divided by the
inflation a for noise that is correlated in time, plus P log(N / a) for its P parameters, with N numbers in the track,
and 2 log S if it chooses one of S poses. Differences of 10 are strong evidence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import FittedCandidate, Noise

STRONG = 10.0  # minimum difference of scores for a break
NEAR = 6.0  # maximum difference of scores within which the simplest law is chosen
_MIN_LEVEL = 0.05
_MAX_LAG = 0.8
_RHOS = np.linspace(0.0, 0.9, 19)  # tried correlations of neighbouring poses
_OUTLYING = 0.5  # robust weight of a pose, relative to the median, below which it is an outlier


@dataclass(frozen=True)
class NoiseLevel:
    """Noise level of a track, from all candidates together.

    Attributes:
        count: Number of poses S.
        level: s2, variance of the scaled residuals.
        inflation: a = (1 + rho) / (1 - rho) of noise with the correlation rho between neighbours.
    """

    count: int
    level: float
    inflation: float

    @staticmethod
    def of(solutions: Sequence[FittedCandidate], least: float = 0.0) -> NoiseLevel:
        """Noise level, at least ``least``, from solutions of which one must be close to the truth."""
        count = len(solutions[0].weights)
        numbers = 6 * count
        level = max(_MIN_LEVEL, least, min(s.loss / max(numbers - s.parameters, 1) for s in solutions))
        best = min(solutions, key=lambda s: s.loss / level + s.parameters * math.log(numbers))
        return NoiseLevel(count, level, _inflation([best], count, best.parameters))

    @staticmethod
    def of_parts(parts: Sequence[FittedCandidate], least: float) -> NoiseLevel:
        """Noise level, at least ``least``, from solutions of successive parts of a track."""
        count, parameters = sum(len(s.weights) for s in parts), sum(s.parameters for s in parts)
        level = sum(s.loss for s in parts) / max(6 * count - parameters, 1)
        return NoiseLevel(count, max(_MIN_LEVEL, least, level), _inflation(parts, count, parameters))

    @property
    def variance(self) -> float:
        """Factor of the parameters' covariance, s2 a."""
        return self.level * self.inflation

    def score(self, solution: FittedCandidate) -> float:
        """B of a candidate; less is better."""
        return self.of_sums(solution.loss, solution.parameters, solution.candidate.discrete_choices)

    def of_sums(self, loss: float, parameters: int, choices: int = 0) -> float:
        """Score B from a loss, the number of parameters and the number of choices of a pose."""
        penalty = parameters * math.log(6 * self.count / self.inflation)
        return loss / self.variance + penalty + 2 * choices * math.log(self.count)


def covariance_factor(solution: FittedCandidate, track: PoseTrack, noise: Noise, noise_level: NoiseLevel) -> float:
    """Factor of the parameters' covariance for noise of an unknown correlation, at least that of the evidence.

    It is the mean of s2 (1 + rho) / (1 - rho), weighted by the restricted likelihood of rho, the correlation of
    neighbouring poses, times a prior 1 - rho, because few poses hardly tell large correlations apart. Unlike rho in
    `_inflation`, this one also includes slow noise that the fit follows. Outliers are left out: beside them, the small
    weight of one pose would look like correlated noise.

    Args:
        solution: The chosen solution, fitted to the track.
        track: Its poses.
        noise: Their noise.
        noise_level: Noise level of the track.
    """
    misses, slopes = families.linearized(solution.candidate, solution.theta, track, noise)
    kept = solution.robust >= _OUTLYING * np.median(solution.robust)
    kept = kept if 6 * kept.sum() > len(slopes) else np.ones(len(track), bool)
    misses, slopes, tau = misses[kept], slopes[:, kept], track.tau[kept]
    weights = np.sqrt(solution.robust * solution.weights)[kept, None]
    free = misses.size - len(slopes)
    if free <= 0:
        return noise_level.variance
    steps = np.diff(tau) / np.median(np.diff(tau))
    phi = _RHOS[:, None, None] ** steps[:, None]  # [R, S - 1, 1]
    rest = np.sqrt(1 - phi**2)
    values = weights * np.concatenate([misses[None], slopes])  # [1 + P, S, 6]
    first = np.broadcast_to(values[:, :1], (len(_RHOS), *values[:, :1].shape))
    white = np.concatenate([first, (values[:, 1:] - phi[:, None] * values[:, :-1]) / rest[:, None]], axis=2)
    white = white.reshape(*white.shape[:2], -1)  # [R, 1 + P, 6 S]
    squares = white @ white.swapaxes(1, 2)
    normal = squares[:, 1:, 1:] + np.diag(solution.candidate.precision**2)
    pull = squares[:, 1:, 0]
    explained = np.einsum("rp,rpq,rq->r", pull, np.linalg.pinv(normal, hermitian=True), pull)
    losses = np.maximum(squares[:, 0, 0] - explained, _MIN_LEVEL**2)
    logs = 12 * np.log(rest).sum((1, 2)) + np.linalg.slogdet(normal)[1] + free * np.log(losses)
    used = np.isfinite(logs)  # if only a weak prior determines a direction, exact poses hide it in rounding
    if not used.any():
        return noise_level.variance
    variances = (losses / free * (1 + _RHOS) / (1 - _RHOS))[used]
    likelihoods = -0.5 * logs[used]
    shares = (1 - _RHOS[used]) * np.exp(likelihoods - likelihoods.max())
    return max(noise_level.variance, float(shares @ variances / shares.sum()))


def _inflation(parts: Sequence[FittedCandidate], count: int, parameters: int) -> float:
    """a from the robustly weighted correlation of neighbouring residuals, which the fit reduces; corrected for that."""
    energy = product = 0.0
    for solution in parts:
        values = np.sqrt(solution.robust)[:, None] * solution.residuals
        energy += float((values**2).sum())
        product += float((values[1:] * values[:-1]).sum())
    lag = product / energy if energy > 0 else 0.0
    rho = min(max(lag + (parameters / 6 + 1) / count, 0.0), _MAX_LAG)
    return (1 + rho) / (1 - rho)

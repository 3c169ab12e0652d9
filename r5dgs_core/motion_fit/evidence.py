"""Evidence for candidate motions: one score for laws with and without breaks.

The score B of a candidate is its Cauchy loss in units of the noise level s2 of the best candidate, divided by the
inflation a for noise that is correlated in time, plus P log(N / a) for its P parameters, with N numbers in the track,
and 2 log S if it chooses one of S poses. Differences of 10 are strong evidence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .candidates import Solution

STRONG = 10.0  # minimum difference of scores for a break
NEAR = 6.0  # maximum difference of scores within which the simplest law is chosen
_LEAST_LEVEL = 0.05
_MOST_LAG = 0.8


@dataclass(frozen=True)
class Evidence:
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
    def of(solutions: Sequence[Solution], least: float = 0.0) -> Evidence:
        """Noise level, at least ``least``, from solutions of which one must be close to the truth."""
        count = len(solutions[0].weights)
        numbers = 6 * count
        level = max(_LEAST_LEVEL, least, min(s.loss / max(numbers - s.parameters, 1) for s in solutions))
        best = min(solutions, key=lambda s: s.loss / level + s.parameters * math.log(numbers))
        return Evidence(count, level, _inflation([best], count, best.parameters))

    @staticmethod
    def of_parts(parts: Sequence[Solution], least: float) -> Evidence:
        """Noise level, at least ``least``, from solutions of successive parts of a track."""
        count, parameters = sum(len(s.weights) for s in parts), sum(s.parameters for s in parts)
        level = sum(s.loss for s in parts) / max(6 * count - parameters, 1)
        return Evidence(count, max(_LEAST_LEVEL, least, level), _inflation(parts, count, parameters))

    @property
    def variance(self) -> float:
        """Factor of the parameters' covariance, s2 a."""
        return self.level * self.inflation

    def score(self, solution: Solution) -> float:
        """B of a candidate; less is better."""
        return self.of_sums(solution.loss, solution.parameters, solution.candidate.placed)

    def of_sums(self, loss: float, parameters: int, placed: int = 0) -> float:
        """Score B from a loss, the number of parameters and the number of choices of a pose."""
        penalty = parameters * math.log(6 * self.count / self.inflation)
        return loss / self.variance + penalty + 2 * placed * math.log(self.count)


def _inflation(parts: Sequence[Solution], count: int, parameters: int) -> float:
    """a from the correlation between neighbouring residuals, weighted robustly; it corrects for the fit."""
    energy = product = 0.0
    for solution in parts:
        values = np.sqrt(solution.robust)[:, None] * solution.residuals
        energy += float((values**2).sum())
        product += float((values[1:] * values[:-1]).sum())
    lag = product / energy if energy > 0 else 0.0
    rho = min(max(lag + (parameters / 6 + 1) / count, 0.0), _MOST_LAG)
    return (1 + rho) / (1 - rho)

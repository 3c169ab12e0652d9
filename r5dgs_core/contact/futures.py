"""Many futures of a body: samples of its state and material, simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special

from ..motion import rotations
from .identify import PARAMETERS, Estimate, Fitter
from .world import Material, State

WIDENED = 2.0  # factor on standard deviations of a fit to poses, calibrated on tosses of a cube
CONTRADICTS = 29.1  # squared change of the poses, in units of the widened noise; 99 % of chi2 of 14 parameters
_ATTEMPTS = 10
_FACE = np.pi / 4  # angle between up directions in the frame of a body beyond which it lies on different faces


@dataclass(frozen=True)
class Futures:
    """Sampled poses of one body, N at each time.

    Attributes:
        times: Times of the poses. [T]
        quats: Unit wxyz, relative to the bind state. [T, N, 4]
        places: Centres of mass. [T, N, 3]
    """

    times: np.ndarray
    quats: np.ndarray
    places: np.ndarray

    def radii(self, center: np.ndarray, level: float) -> np.ndarray:
        """Distances from places [T, 3] within which the share ``level`` of the samples lies. [T]"""
        return np.quantile(np.linalg.norm(self.places - center[:, None], axis=-1), level, axis=1)

    def angles(self, quats: np.ndarray, level: float) -> np.ndarray:
        """Angles to rotations [T, 4] within which the share ``level`` of the samples lies, rad. [T]"""
        return np.quantile(rotations.angle_between(self.quats, quats[:, None]), level, axis=1)

    def other_faces(self, quat: np.ndarray, up: np.ndarray) -> float:
        """Share of the samples that end on another face than a predicted rotation [4]; see `on_other_face`."""
        return float(on_other_face(self.quats[-1], quat, up).mean())


def on_other_face(quats: np.ndarray, quat: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return True for rotations that put a body on another face than a given one; turns about ``up`` do not. [...]

    Args:
        quats: Rotations, unit wxyz, from the body to the world. [..., 4]
        quat: The given rotation. [4]
        up: Unit normal of the support, in the world. [3]
    """
    upward = rotations.rotate(rotations.conjugate(quats), np.broadcast_to(up, (*quats.shape[:-1], 3)))
    return upward @ rotations.rotate(rotations.conjugate(quat), up) < np.cos(_FACE)


def normals(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw standard normal parameters, one value from each of ``count`` equally likely intervals. [count, 14]

    Shares and quantiles of so many draws are as exact as those of twice as many independent ones.

    Source: Latin hypercube sampling (McKay, Beckman and Conover, 1979).
    """
    intervals = rng.permuted(np.tile(np.arange(count), (PARAMETERS, 1)), axis=1).T
    return special.ndtri((intervals + rng.uniform(1e-9, 1 - 1e-9, intervals.shape)) / count)


def draws(fitter: Fitter, estimate: Estimate, count: int, rng: np.random.Generator) -> Iterator[tuple[State, Material]]:
    """Yield ``count`` states and materials that are drawn from an estimate.

    Standard deviations that come from poses are multiplied by `WIDENED`, those of a prior are not.
    Draws that contradict the poses are repeated, the last ones closer to the estimate. In contact, the poses are no
    linear function of the state: a body that moves into the floor stays, and one that moves away from it flies.
    """
    assumed = np.diag(estimate.assumed)
    told = np.linalg.inv(estimate.covariance) - assumed
    root = np.linalg.cholesky(np.linalg.inv(told / WIDENED**2 + assumed))
    fitted = fitter.residuals(estimate.state, estimate.material, estimate.time)
    for first in normals(count, rng):
        found = estimate.state, estimate.material
        for attempt in range(2 * _ATTEMPTS):
            closer = 0.5 ** max(attempt - _ATTEMPTS, 0)
            numbers = rng.normal(size=PARAMETERS) if attempt else first
            drawn = fitter.moved(estimate.state, estimate.material, closer * root @ numbers)
            change = fitter.residuals(*drawn, estimate.time) - fitted
            if (change**2).sum() <= WIDENED**2 * CONTRADICTS:
                found = drawn
                break
        yield found


def sample(
    fitter: Fitter,
    estimate: Estimate,
    times: np.ndarray,
    count: int,
    rng: np.random.Generator,
) -> Futures:
    """Simulate samples of an estimate.

    Args:
        fitter: The fitter of the body.
        estimate: Its result.
        times: Times, increasing and not before that of the estimate. [T]
        count: Number of samples N.
        rng: Source of the samples.
    """
    quats, places = np.empty((len(times), count, 4)), np.empty((len(times), count, 3))
    for n, (state, material) in enumerate(draws(fitter, estimate, count, rng)):
        quats[:, n], places[:, n] = fitter.poses(state, material, times - estimate.time)
    good = np.isfinite(places).all(axis=(0, 2))
    return Futures(times, quats[:, good], places[:, good])

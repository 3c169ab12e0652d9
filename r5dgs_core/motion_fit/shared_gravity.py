"""One acceleration for all bodies that fall: each alone knows it worse than all together.

Notation: a_i the acceleration that the fit of body i found, C_i its covariance, in world units; B a basis of the
accelerations that may be: all directions, or the upward one alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import model_selection, rest_detection

# Motions whose acceleration is free -> the same without it.
FALLING = {"translation, quadratic": "translation", "ballistic + spin": "translation + spin"}
AGREE = 11.34  # squared distance of two accelerations over their covariance: chi2 with three degrees, 99 %


@dataclass(frozen=True)
class Track:
    """What a body's fit was made of, as in `model_selection.fit`.

    Attributes:
        times: Increasing, the last is t_max. [S]
        quats: Unit wxyz. [S, 4]
        displacements: Of the pivot, world units. [S, 3]
        weights: Of the poses. [S]
    """

    times: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    weights: np.ndarray


def share(
    tracks: Sequence[Track], fits: Sequence[model_selection.Fit], up: np.ndarray | None = None
) -> tuple[list[model_selection.Fit], tuple[int, ...]]:
    """Give bodies that fall alike one acceleration, the weighted mean of theirs, and fit the rest of their motion anew.

    Args:
        tracks: Of all bodies.
        fits: Of all bodies, in the same order.
        up: Direction that the acceleration lies along, or None where that is not known. [3]

    Returns:
        The fits, those of others unchanged to the bit, and the indices of the bodies that share: at least two, that
        each picked a motion of `FALLING` and agree in pairs within their covariances; none where they do not.

    Source: generalized least squares for the mean; a motion with a fixed acceleration is one without it whose
        displacements have a tau^2 / 2 added.
    """
    basis = np.eye(3)
    if up is not None:
        up = np.asarray(up, np.float64)
        if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
            raise ValueError(f"up: expected a direction, got {up!r}")
        basis = up[:, None] / np.linalg.norm(up)
    found = {i: _acceleration(fit) for i, fit in enumerate(fits) if fit.chosen in FALLING and not fit.rested}
    if up is not None:
        found = {i: (a, cov) for i, (a, cov) in found.items() if _apart(a, cov, *_mean([(a, cov)], basis)) < AGREE}
    agreeing = _largest_agreeing(found)
    if len(agreeing) < 2:
        return list(fits), ()
    common, covariance = _mean([found[i] for i in agreeing], basis)
    result = list(fits)
    for i in agreeing:
        result[i] = _refit(tracks[i], fits[i], common, covariance)
    return result, tuple(agreeing)


def _acceleration(fit: model_selection.Fit) -> tuple[np.ndarray, np.ndarray]:
    """Acceleration of a fit and its covariance. [3], [3, 3]"""
    assert fit.model.covariance is not None
    rows = [fit.model.covariance_names.index(f"acceleration.{axis}") for axis in "xyz"]
    floor = (rest_detection.SIGMA_FLOOR * fit.model.radius) ** 2  # without noise nothing would agree
    return fit.model.acceleration, fit.model.covariance[np.ix_(rows, rows)] + floor * np.eye(3)


def _mean(found: list[tuple[np.ndarray, np.ndarray]], basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The acceleration of the span of the basis that all say together, and its covariance. [3], [3, 3]"""
    precisions = [np.linalg.inv(covariance) for _, covariance in found]
    normal = basis.T @ sum(precisions) @ basis
    right = basis.T @ sum(p @ a for p, (a, _) in zip(precisions, found, strict=True))
    return basis @ np.linalg.solve(normal, right), basis @ np.linalg.inv(normal) @ basis.T


def _apart(a: np.ndarray, a_cov: np.ndarray, b: np.ndarray, b_cov: np.ndarray) -> float:
    """Squared distance of two accelerations over the covariance of their difference."""
    return float((a - b) @ np.linalg.solve(a_cov + b_cov, a - b))


def _largest_agreeing(found: dict[int, tuple[np.ndarray, np.ndarray]]) -> list[int]:
    """The largest set whose members agree with each other, the closest of equally large ones."""
    best: tuple[int, float, list[int]] = (0, 0.0, [])
    for seed in found:
        distances = {i: _apart(*found[seed], *found[i]) for i in found if i != seed}
        chosen, total = [seed], 0.0
        for i in sorted(distances, key=lambda i: distances[i]):
            if all(_apart(*found[i], *found[j]) < AGREE for j in chosen):
                chosen, total = [*chosen, i], total + distances[i]
        best = max(best, (len(chosen), -total, chosen), key=lambda entry: entry[:2])
    return sorted(best[2])


def _refit(
    track: Track, fit: model_selection.Fit, acceleration: np.ndarray, covariance: np.ndarray
) -> model_selection.Fit:
    """The fit with a given acceleration; the same fit where the rest of the motion does not come out as before."""
    tau = track.times - track.times[-1]
    without = track.displacements - 0.5 * acceleration * tau[:, None] ** 2
    again = model_selection.fit(
        track.times,
        track.quats,
        without,
        radius=fit.model.radius,
        weights=track.weights,
        candidates=[FALLING[fit.chosen]],
    )
    if again.rested or again.model.covariance is None:
        return fit
    names = again.model.covariance_names
    rows = [names.index(f"acceleration.{axis}") for axis in "xyz"]
    spread = again.model.covariance.copy()
    spread[np.ix_(rows, rows)] = covariance
    model = dataclasses.replace(again.model, acceleration=acceleration, covariance=spread)
    late = again.band_tau**4 * float(np.trace(covariance))  # four variances of a tau^2 / 2
    return dataclasses.replace(
        again, model=model, scores=fit.scores, chosen=fit.chosen, band=np.sqrt(again.band**2 + late)
    )

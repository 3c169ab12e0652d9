"""Shared acceleration of falling bodies, estimated jointly from their individual fits.

Notation: a_i the acceleration from the fit of body i, C_i its covariance, in world units; B a basis of the allowed
accelerations: all directions, or the vertical alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import model_selection, noise

# Each candidate with a free acceleration, and the candidate without it.
FALLING = {"translation, quadratic": "translation", "ballistic + spin": "translation + spin"}
AGREE = 11.34  # maximum squared Mahalanobis distance: 99 % quantile of chi2 with three degrees of freedom


@dataclass(frozen=True)
class BodyTrack:
    """Observed poses of one body, as passed to `model_selection.fit`.

    Attributes:
        times: Increasing, the last is t_max. [S]
        quats: Unit wxyz. [S, 4]
        displacements: Displacements of the pivot, world units. [S, 3]
        weights: Pose weights. [S]
    """

    times: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    weights: np.ndarray


def share_acceleration(
    tracks: Sequence[BodyTrack], fits: Sequence[model_selection.Fit], up: np.ndarray | None = None
) -> tuple[list[model_selection.Fit], tuple[int, ...]]:
    """Replace the accelerations of bodies that fall alike by their weighted mean, and refit the rest of their motion.

    Args:
        tracks: Tracks of all bodies.
        fits: Fits of all bodies, in the same order.
        up: Line along which the acceleration lies, or None if unknown. [3]

    Returns:
        The fits, unchanged for all other bodies, and the indices of the sharing bodies: at least two whose selected
        motion is in `FALLING` and whose accelerations agree in pairs within their covariances; else empty.

    Source: generalized least squares for the mean; a motion with a fixed acceleration is fitted by subtracting a
        tau^2 / 2 from the displacements.
    """
    basis = np.eye(3)
    if up is not None:
        up = np.asarray(up, np.float64)
        if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
            raise ValueError(f"up: expected a direction, got {up!r}")
        basis = up[:, None] / np.linalg.norm(up)
    found = {
        i: _acceleration(fit)
        for i, fit in enumerate(fits)
        if fit.chosen in FALLING and not (fit.rested or fit.history.events or fit.slips)
    }
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
    floor = (noise.FLOOR * fit.model.radius) ** 2  # so that noise-free fits can agree
    return fit.model.acceleration, fit.model.covariance[np.ix_(rows, rows)] + floor * np.eye(3)


def _mean(found: list[tuple[np.ndarray, np.ndarray]], basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean acceleration within the span of the basis, and its covariance. [3], [3, 3]"""
    precisions = [np.linalg.inv(covariance) for _, covariance in found]
    normal = basis.T @ sum(precisions) @ basis
    right = basis.T @ sum(p @ a for p, (a, _) in zip(precisions, found, strict=True))
    return basis @ np.linalg.solve(normal, right), basis @ np.linalg.inv(normal) @ basis.T


def _apart(a: np.ndarray, a_cov: np.ndarray, b: np.ndarray, b_cov: np.ndarray) -> float:
    """Squared Mahalanobis distance of two accelerations."""
    return float((a - b) @ np.linalg.solve(a_cov + b_cov, a - b))


def _all_apart(accelerations: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return `_apart` of all pairs of accelerations [B, 3] with their covariances [B, 3, 3]. [B, B]"""
    rows = []
    for a, covariance in zip(accelerations, covariances, strict=True):
        off = accelerations - a
        rows.append((off * np.linalg.solve(covariances + covariance, off[..., None])[..., 0]).sum(-1))
    return np.stack(rows)


def _largest_agreeing(found: dict[int, tuple[np.ndarray, np.ndarray]]) -> list[int]:
    """Large set of bodies that agree in pairs, grown greedily from each body; among equally large, the tightest."""
    if not found:
        return []
    apart = _all_apart(*(np.stack(part) for part in zip(*found.values(), strict=True)))
    agree = apart < AGREE
    best: tuple[int, float, list[int]] = (0, 0.0, [])
    for seed in range(len(found)):
        chosen, total, fits = [seed], 0.0, agree[seed].copy()
        for i in np.argsort(apart[seed], kind="stable").tolist():
            if i != seed and fits[i]:
                chosen.append(i)
                total += float(apart[seed, i])
                fits &= agree[i]
        best = max(best, (len(chosen), -total, chosen), key=lambda entry: entry[:2])
    names = list(found)
    return sorted(names[i] for i in best[2])


def _refit(
    track: BodyTrack, fit: model_selection.Fit, acceleration: np.ndarray, covariance: np.ndarray
) -> model_selection.Fit:
    """Refit a body with a given acceleration; returns the old fit if the new one is at rest or has no covariance."""
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
    band = again.history.band
    if band is not None:
        late = (np.array(band.times) - track.times[-1]) ** 4 * float(np.trace(covariance))  # (2 sigma)^2 of a tau^2 / 2
        widths = np.sqrt(np.array(band.half_width) ** 2 + late)
        band = dataclasses.replace(band, half_width=tuple(widths.tolist()))
    history = dataclasses.replace(again.history, band=band, errors=fit.history.errors)
    return dataclasses.replace(again, model=model, scores=fit.scores, chosen=fit.chosen, history=history)

"""Position uncertainty of an extrapolated body, from the covariance of its motion model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from . import models, rotations

_STEP = 1e-4  # finite-difference step, in standard deviations of the rate
_TURNED = 2 / 3  # mean over a sphere of |dtheta x r|^2 for |r| = 1


def position_sigma(model: models.MotionModel, tau: np.ndarray) -> np.ndarray:
    """Standard deviation of a body point's position, to first order in the rate errors.

    Propagates the covariance of the rates to the displacement of the pivot and, through rotation, to a point at
    ``model.radius``, averaged over directions. It ignores the noise of the bind state and alternative models that fit
    the observed poses equally well. The true error therefore exceeds one sigma more often than a third of the time.

    Args:
        model: The motion.
        tau: Times since t_max, >= 0. [H]

    Returns:
        World units, 0 at tau = 0; all zero if the model has no covariance. [H]
    """
    tau = np.asarray(tau, np.float64)
    if model.covariance is None or len(model.covariance_names) == 0:
        return np.zeros(len(tau))
    sigmas = np.sqrt(np.maximum(np.diag(model.covariance), 0.0))
    known = [k for k in np.flatnonzero(sigmas > 0) if _affects_motion(model, model.covariance_names[k])]
    if not known:
        return np.zeros(len(tau))
    quats, displacements = models.evaluate(model, tau)
    slopes = np.empty((len(known), len(tau), 6))
    for row, k in enumerate(known):
        step = _STEP * sigmas[k]
        moved_quats, moved = models.evaluate(_shifted(model, model.covariance_names[k], step), tau)
        turns = rotations.quats_to_rotvecs(rotations.multiply(moved_quats, rotations.conjugate(quats)))
        slopes[row] = np.concatenate([moved - displacements, turns], axis=-1) / step
    covariance = model.covariance[np.ix_(known, known)]
    spread = np.einsum("phc,pq,qhc->hc", slopes, covariance, slopes)
    variance = spread[:, :3].sum(-1) + _TURNED * model.radius**2 * spread[:, 3:].sum(-1)
    return np.sqrt(np.maximum(variance, 0.0))


def with_exact_fields(model: models.MotionModel, names: set[str]) -> models.MotionModel:
    """Zero the covariance of some of the model's fields, so that they count as exact.

    Args:
        model: The motion.
        names: Names of the fields, such as "velocity".
    """
    if model.covariance is None or not names:
        return model
    keep = np.array([name.split(".")[0] not in names for name in model.covariance_names], bool)
    return replace(model, covariance=model.covariance * keep[:, None] * keep[None, :])


def _affects_motion(model: models.MotionModel, name: str) -> bool:
    """Return False for a rate that does not affect the motion: "frequency" of a model that does not oscillate."""
    return name != "frequency" or model.frequency > 0


def _shifted(model: models.MotionModel, name: str, step: float) -> models.MotionModel:
    field, _, axis = name.partition(".")
    if not axis:
        return replace(model, **{field: getattr(model, field) + step})
    vector = getattr(model, field).copy()
    vector["xyz".index(axis)] += step
    return replace(model, **{field: vector})

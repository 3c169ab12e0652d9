"""Robust rigid registration of two point clouds with known correspondences.

Notation: x_i source, y_i target, w_i weights, c and c' their weighted centroids. The fit is y = c' + R (x - c).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import robust_weights, rotations

UNDETERMINED_RAD = 0.1
ALIASED_RAD = np.radians(120.0)
_LEAST_INERTIA = 1e-300  # over the variance of the residuals; the quotient of a smaller one overflows


@dataclass(frozen=True)
class RigidFit:
    """A fitted rigid motion.

    Attributes:
        quat: Rotation R, unit wxyz. [4]
        displacement: Displacement of the weighted centroid, c' - c. [3]
        center: Weighted centroid of the source, c. [3]
        residuals: Distance of each target point from its fitted position. [n]
        weights: Final weights: the given ones times the robust ones. [n]
        undetermined_axes: Directions in the source frame about which the points do not determine the rotation. [0..3,
            3]
        rotation_covariance: Covariance of the rotation vector, source frame, rad^2; pi^2 on undetermined axes. [3, 3]
    """

    quat: np.ndarray
    displacement: np.ndarray
    center: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    undetermined_axes: np.ndarray
    rotation_covariance: np.ndarray

    def displacement_at(self, point: np.ndarray) -> np.ndarray:
        """Displacement of any point that moves with the body, such as the group's pivot. [..., 3]"""
        return self.center + self.displacement + rotations.rotate(self.quat, point - self.center) - point


def fit_rigid(
    source: np.ndarray,  # [n, 3]
    target: np.ndarray,  # [n, 3]
    weights: np.ndarray | None = None,  # [n]
    *,
    rounds: int = 6,
    hint: np.ndarray | None = None,  # [4]
) -> RigidFit:
    """Fit a rotation and a translation robustly (Kabsch with Cauchy reweighting).

    If the points do not determine the rotation about an axis (a line, a single point, noise larger than the lever arm),
    that part is taken from ``hint``: of all rotations that fit, the result is the one nearest to it.

    Args:
        source: Points before. [n, 3]
        target: The same points after. [n, 3]
        weights: Point weights, >= 0 with a positive sum, or None for equal ones. [n]
        rounds: Maximum number of reweighting rounds; reweighting stops once no residual is far above the median.
        hint: Expected rotation, unit wxyz; None for the identity.

    Returns:
        The fit; det R = +1 always.

    Source: Kabsch 1976 (`rotations.nearest_rotmats`), reweighted by `robust_weights`; rotation covariance sigma^2 J^-1
        with J = sum w (|r|^2 I - r r^T).
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    base = np.ones(len(source)) if weights is None else np.asarray(weights, np.float64)
    _check(source, target, base)
    current = base / base.sum()
    quat, center, moved, residuals = _kabsch(source, target, current)
    size = float(np.sqrt(np.sum(current * ((source - center) ** 2).sum(-1))))
    for _ in range(rounds):
        used = residuals[base > 0]
        if not robust_weights.has_outliers(used, 1e-12 * max(size, 1e-300)):
            break
        scale = robust_weights.cauchy_scale(used, 1e-9 * max(size, 1e-300))
        current = robust_weights.reweight(base, residuals, scale)
        current = current / current.sum()
        quat, center, moved, residuals = _kabsch(source, target, current)

    if size <= 1e-14 * float(np.abs(source).max()):  # coincident points; the rest is rounding of the centroid
        size = 0.0
    axes, covariance = _uncertainty(source - center, residuals, current, size)
    if len(axes):
        known = np.array([1.0, 0, 0, 0]) if hint is None else rotations.normalize(np.asarray(hint, np.float64))
        quat = known
        if len(axes) == 1:
            fitted, _, _, _ = _kabsch(source, target, current)
            start, end = rotations.rotate(known, axes[0]), rotations.rotate(fitted, axes[0])
            quat = rotations.multiply(rotations.between_vectors(start, end), known)
        residuals = np.linalg.norm(target - moved - rotations.rotate(quat, source - center), axis=-1)
    return RigidFit(quat, moved - center, center, residuals, current, axes, covariance)


def _check(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> None:
    """Raise ValueError for arguments that `fit_rigid` cannot use."""
    if source.ndim != 2 or source.shape[1:] != (3,) or source.shape != target.shape or len(source) == 0:
        raise ValueError(f"expected two equal shapes (n, 3) with n >= 1, got {source.shape} and {target.shape}")
    if weights.shape != (len(source),) or not (weights >= 0).all() or not weights.sum() > 0:
        raise ValueError(f"weights: expected ({len(source)},) numbers >= 0 with a positive sum")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("source, target: expected finite points")


def aliased_step(times: np.ndarray, quats: np.ndarray) -> tuple[float, float, float] | None:
    """Return the largest rotation between neighbouring poses if it exceeds 120 degrees, else None.

    A rotation of more than 180 degrees looks like a smaller one backwards. A body with steps near that limit may
    actually spin the other way; only more frequent poses resolve this.

    Args:
        times: Times of the poses, increasing. [S]
        quats: Unit wxyz. [S, 4]

    Returns:
        The angle in rad, and the two times.
    """
    if len(times) < 2:
        return None
    angles = rotations.angle_between(quats[:-1], quats[1:])
    k = int(np.argmax(angles))
    return (float(angles[k]), float(times[k]), float(times[k + 1])) if angles[k] > ALIASED_RAD else None


def _kabsch(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rotation, both centroids and the residuals, for weights that sum to 1."""
    center, moved = weights @ source, weights @ target
    x, y = source - center, target - moved
    rotmat = rotations.nearest_rotmats((y * weights[:, None]).T @ x)
    return rotations.rotmats_to_quats(rotmat), center, moved, np.linalg.norm(y - x @ rotmat.T, axis=-1)


def _uncertainty(
    offsets: np.ndarray, residuals: np.ndarray, weights: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Axes that the points leave undetermined, and the covariance of the rotation, both in the source frame."""
    relative = weights / weights.max()
    inertia = np.einsum("n,nij->ij", relative, inertias(offsets))
    dof = max(3 * float(relative.sum()) - 6, 1.0)
    sigma2 = float(np.sum(relative * residuals**2)) / dof
    values, vectors = np.linalg.eigh(inertia)
    floor = 1e-12 * max(float(values[-1]), 1e-300)
    known = (values > floor) & (values > _LEAST_INERTIA * sigma2)
    variances = np.where(known, sigma2 / np.where(known, values, 1.0), np.pi**2)
    spread = float(np.abs(offsets).max()) if len(offsets) else 0.0
    free = (values <= floor) | (variances > UNDETERMINED_RAD**2)
    if spread <= 1e-300 or size <= 1e-300 or free.sum() > 1:
        free[:] = True
    variances = np.minimum(np.where(free, np.pi**2, variances), np.pi**2)
    return vectors[:, free].T.copy(), (vectors * variances) @ vectors.T


def inertias(offsets: np.ndarray) -> np.ndarray:
    """|r|^2 I - r r^T of each point. [n, 3] -> [n, 3, 3]"""
    squares = (offsets**2).sum(-1)[:, None, None] * np.eye(3)
    return squares - offsets[:, :, None] * offsets[:, None, :]

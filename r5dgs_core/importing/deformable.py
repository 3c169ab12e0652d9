"""Reader of Deformable-3DGS runs, whose network outputs are added to the canonical rotations and scales.

The 3DGS rasterizer does not normalise quaternions, so the matrix of q + dq is not a rotation: q + dq = (w, v) rotates
about v by atan2(2 w |v|, 1 - 2 |v|^2) and scales perpendicular to v. The rendered covariance is A A^T,
A = matrix(q + dq) diag(exp(s) + ds). The scene stores its principal axes.
"""

from __future__ import annotations

import numpy as np
import torch

from ..formats import ply
from ..motion import rotations
from . import networks, weights
from .foreign_run import SPLATTING_NEAR, ForeignRun, State
from .run_folder import RunFolder

_SMALLEST = 1e-12  # minimum standard deviation, if exp(s) + ds vanishes, world units
_ROUNDING = 1e-14  # share of the trace below which off-diagonal elements are rounding errors of float64
_SWEEPS = 8  # Jacobi converges quadratically; float64 needs far fewer for 3 x 3


def read(run: RunFolder) -> ForeignRun:
    """Read the Gaussians and their deformation network."""
    splats = ply.read(run.ply)
    network = networks.read_deform(weights.load(run.weights("deform.pth")))

    def state(rows: slice, t: float) -> State:
        with torch.no_grad():
            means = torch.from_numpy(splats.means[rows])
            change = network(means, t)
            moved = change.move(means).double().numpy()
        quats = splats.quats[rows].astype(np.float64) + change.quats.double().numpy()
        scales = np.exp(splats.log_scales[rows].astype(np.float64)) + change.scales.double().numpy()
        return State(moved, *principal_axes(quats, scales))

    return ForeignRun("deformable_3dgs", splats, SPLATTING_NEAR, state=state)


def principal_axes(quats: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and log scales of the Gaussians that 3DGS renders for quaternions of any length and any scales.

    Args:
        quats: wxyz. [n, 4] float64
        scales: Signed standard deviations along the axes before the quaternion is applied. [n, 3] float64

    Returns:
        Unit quaternions wxyz [n, 4] and log scales [n, 3]. The axes are those nearest to the given ones, in the same
        order, so that both are continuous over time; for unit quaternions they are the given ones.
    """
    linear = rotations.quats_to_rotmats(quats) * scales[:, None, :]
    axes = rotations.quats_to_rotmats(_turn_of(quats))
    inner = np.swapaxes(axes, -1, -2) @ linear
    covariance = inner @ np.swapaxes(inner, -1, -2)
    for _ in range(_SWEEPS):
        before = axes
        for p, q in ((0, 1), (0, 2), (1, 2)):
            covariance, axes = _rotate_pair(covariance, axes, p, q)
        if axes is before:
            break
    variances = np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), _SMALLEST**2)
    return rotations.rotmats_to_quats(axes), 0.5 * np.log(variances)


def _turn_of(quats: np.ndarray) -> np.ndarray:
    """Rotational part, unit wxyz, of the matrices of quaternions of any length. [n, 4]"""
    w, v = quats[:, :1], quats[:, 1:]
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = np.arctan2(2 * w * length, 1 - 2 * length**2)
    return rotations.rotvecs_to_quats(v * np.divide(angle, length, out=np.zeros_like(length), where=length > 0))


def _rotate_pair(covariance: np.ndarray, axes: np.ndarray, p: int, q: int) -> tuple[np.ndarray, np.ndarray]:
    """Apply one Jacobi rotation by at most 45 degrees that zeroes element (p, q). [n, 3, 3] each"""
    off = covariance[:, p, q]
    wanted = np.abs(off) > _ROUNDING * np.trace(covariance, axis1=-2, axis2=-1)
    if not wanted.any():
        return covariance, axes
    with np.errstate(over="ignore"):  # an infinite ratio gives no rotation
        ratio = np.divide(covariance[:, q, q] - covariance[:, p, p], 2 * off, out=np.zeros_like(off), where=wanted)
        tangent = np.where(wanted, np.copysign(1, ratio) / (np.abs(ratio) + np.sqrt(1 + ratio * ratio)), 0)
    c = 1 / np.sqrt(1 + tangent * tangent)
    turn = np.broadcast_to(np.eye(3), covariance.shape).copy()
    turn[:, p, p] = turn[:, q, q] = c
    turn[:, p, q], turn[:, q, p] = tangent * c, -tangent * c
    return np.swapaxes(turn, -1, -2) @ covariance @ turn, axes @ turn

"""Deformable-3DGS: rotations and scales of the network are added to the canonical ones.

Its rasterizer (that of 3DGS) does not normalise what it is given, so q + dq acts as a matrix that is no rotation: with
q + dq = (w, v) it turns about v by atan2(2 w |v|, 1 - 2 |v|^2) and scales across v. What is drawn has the covariance
A A^T, A = matrix(q + dq) diag(exp(s) + ds); its principal axes are what a scene can hold.
"""

from __future__ import annotations

import numpy as np
import torch

from ..formats import ply
from ..motion import rotations
from . import networks, weights
from .foreign_run import SPLATTING_NEAR, Foreign, State
from .run_folder import RunFolder

_SMALLEST = 1e-12  # standard deviation that a Gaussian keeps where exp(s) + ds vanishes, world units
_ROUNDING = 1e-14  # of the sum of variances: what float64 leaves off the diagonal of spheres and discs
_SWEEPS = 8  # Jacobi converges quadratically: far more than float64 needs for 3 x 3


def read(run: RunFolder) -> Foreign:
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

    return Foreign("deformable_3dgs", splats, SPLATTING_NEAR, state=state)


def principal_axes(quats: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and log scales of the Gaussians that 3DGS draws for quaternions of any length and scales of any sign.

    Args:
        quats: wxyz. [n, 4] float64
        scales: Standard deviations along the axes before the quaternion acts. [n, 3] float64

    Returns:
        Unit quaternions wxyz [n, 4] and log scales [n, 3]. The axes are those nearest to the ones given, in the same
        order, so that both are continuous along time; for unit quaternions they are the ones given.
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
    """Rotational part, unit wxyz, of the matrices that quaternions of any length stand for. [n, 4]"""
    w, v = quats[:, :1], quats[:, 1:]
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = np.arctan2(2 * w * length, 1 - 2 * length**2)
    return rotations.rotvecs_to_quats(v * np.divide(angle, length, out=np.zeros_like(length), where=length > 0))


def _rotate_pair(covariance: np.ndarray, axes: np.ndarray, p: int, q: int) -> tuple[np.ndarray, np.ndarray]:
    """One Jacobi rotation by at most 45 degrees that makes element (p, q) zero. [n, 3, 3] each"""
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

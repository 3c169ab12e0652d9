"""Knots of a trajectory: poses with velocities before and after them, as rows of an array."""

from __future__ import annotations

import numpy as np

from . import rotations, se3

COLUMNS = 20
TIME, PLACE, QUAT = 0, slice(1, 4), slice(4, 8)
VELOCITY = slice(8, 11), slice(11, 14)  # before and after the knot
SPIN = slice(14, 17), slice(17, 20)


def pack(
    times: np.ndarray,  # [K]
    poses: se3.Pose,  # [K, 4], [K, 3]
    velocities: tuple[np.ndarray, np.ndarray],  # [K, 3] each
    spins: tuple[np.ndarray, np.ndarray],  # [K, 3] each
) -> np.ndarray:  # [K, 20]
    """Return knots for `MotionModel.knots`.

    Args:
        times: Times since t_max, increasing from 0. [K]
        poses: Quaternions [K, 4] and displacements [K, 3] relative to the bind state; the first is the identity.
        velocities: Before and after each knot, world units per unit of time. [K, 3] each
        spins: Angular velocities before and after each knot, world frame, rad per unit of time. [K, 3] each
    """
    return np.concatenate([times[:, None], poses[1], poses[0], *velocities, *spins], axis=1)


def checked(knots: object) -> np.ndarray:
    """Return knots as a read-only array. Raises ValueError that states what was expected. [K, 20]"""
    try:
        array = np.array(knots, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if not len(array) or array.shape != (len(array), COLUMNS) or not np.isfinite(array).all():
        raise ValueError(f"knots: expected finite numbers of shape (K, {COLUMNS}), got {array.shape}")
    if (np.diff(array[:, TIME]) <= 0).any():
        raise ValueError("knots: expected increasing times")
    norms = np.linalg.norm(array[:, QUAT], axis=1)
    if not np.allclose(norms, 1, atol=1e-6):
        raise ValueError(f"knots: expected unit quaternions, got the norm {norms[np.argmax(np.abs(norms - 1))]:g}")
    if array[0, TIME] != 0 or array[0, PLACE].any() or array[0, QUAT].tolist() != [1, 0, 0, 0]:
        raise ValueError("knots: expected the first one at time 0, in the pose at t_max")
    array.flags.writeable = False
    return array


def transformed(knots: np.ndarray, turn: np.ndarray, scale: float) -> np.ndarray:
    """Knots after a similarity of the world, see `MotionModel.transformed`. [K, 20]"""
    found = knots.copy()
    quat = rotations.rotmats_to_quats(turn)
    found[1:, QUAT] = rotations.multiply(rotations.multiply(quat, knots[1:, QUAT]), rotations.conjugate(quat))
    for part in (PLACE, *VELOCITY):
        found[:, part] = scale * knots[:, part] @ turn.T
    for part in SPIN:
        found[:, part] = knots[:, part] @ turn.T
    return found

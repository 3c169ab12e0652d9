"""Points in front of test cameras, and pixels of calibrated cameras, first pixel's centre at 0.5."""

import numpy as np

BOUND = 0.01  # px
POINTS = np.random.default_rng(3).uniform(-0.3, 0.3, (50, 3))


def pixels(lens, camera_to_world: np.ndarray, points: np.ndarray = POINTS) -> np.ndarray:
    """Project world points; all must be seen. [N, 3] -> [N, 2]"""
    found = lens.project((points - camera_to_world[:3, 3]) @ camera_to_world[:3, :3])
    assert np.isfinite(found).all()
    return found


def rotation(seed: int, angle: float = 0.4) -> np.ndarray:
    """Return a rotation matrix of a small angle, rad, about a random axis. [3, 3]"""
    axis = np.random.default_rng(seed).normal(size=3)
    x, y, z = angle * axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross

"""Lens models: from a direction in camera axes to the distorted image plane at focal length 1.

A model first maps a direction to a plane: the tangent plane, (x / z, y / z), or the plane of angles, the unit vector
along (x, y) times the angle to the axis in rad. `Model.distort` then moves points of this plane.

Sources: OpenCV, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; COLMAP, `sensor/models.h`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

TANGENT, ANGLES = "tangent", "angles"


@dataclass(frozen=True)
class Model:
    """A lens model.

    Attributes:
        plane: `TANGENT` for lenses that see less than half of all directions, or `ANGLES`.
        counts: Permitted numbers of coefficients.
        distort: Function from points of the plane [N, 2] and coefficients to the image plane [N, 2].
    """

    plane: str
    counts: tuple[int, ...]
    distort: Callable[[np.ndarray, tuple[float, ...]], np.ndarray]


def _keep(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    return points


def _brown(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """OpenCV's model: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = (*coefficients, *[0.0] * (14 - len(coefficients)))
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    if not (tau_x or tau_y):
        return np.stack([u, v], 1)
    # The sensor is tilted: a rotation, followed by the projection back onto the plane z = 1.
    cos_x, sin_x, cos_y, sin_y = math.cos(tau_x), math.sin(tau_x), math.cos(tau_y), math.sin(tau_y)
    turn = np.array([[cos_y, sin_x * sin_y, -sin_y * cos_x], [0, cos_x, sin_x], [sin_y, -cos_y * sin_x, cos_y * cos_x]])
    back = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    tilted = np.stack([u, v, np.ones_like(u)], 1) @ (back @ turn).T
    return tilted[:, :2] / tilted[:, 2:]


def _fisheye(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Kannala and Brandt's model: radius = angle (1 + k1 angle^2 + k2 angle^4 + ...)."""
    r2 = (points * points).sum(1)
    factor, power = np.ones_like(r2), np.ones_like(r2)
    for k in coefficients:
        power = power * r2
        factor = factor + k * power
    return points * factor[:, None]


def _field_of_view(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Devernay and Faugeras' model with the field of view omega, rad."""
    (omega,) = coefficients
    if abs(omega) < 1e-6:
        return points
    r = np.sqrt((points * points).sum(1))
    safe = np.maximum(r, 1e-12)
    factor = np.where(
        r < 1e-9, 2 * math.tan(omega / 2) / omega, np.arctan(2 * safe * math.tan(omega / 2)) / safe / omega
    )
    return points * factor[:, None]


def _thin_prism(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """COLMAP's model: k1 k2 p1 p2 k3 k4 sx1 sy1."""
    k1, k2, p1, p2, k3, k4, sx, sy = coefficients
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + sx * r2
    v = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + sy * r2
    return np.stack([u, v], 1)


def _project_aria(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Model of Project Aria: k0 .. k5, p0 p1, s0 .. s3; tangential and prism terms use the radially moved point."""
    moved = _fisheye(points, coefficients[:6])
    p0, p1, s0, s1, s2, s3 = coefficients[6:]
    x, y = moved[:, 0], moved[:, 1]
    r2 = x * x + y * y
    u = x + p0 * (r2 + 2 * x * x) + 2 * p1 * x * y + r2 * (s0 + r2 * s1)
    v = y + p1 * (r2 + 2 * y * y) + 2 * p0 * x * y + r2 * (s2 + r2 * s3)
    return np.stack([u, v], 1)


def _division(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Fitzgibbon's model: the image point p has the direction (p, 1 + k |p|^2)."""
    (k,) = coefficients
    angle = np.sqrt((points * points).sum(1))
    cos, sinc = np.cos(angle), np.sinc(angle / math.pi)  # sin(angle) / angle
    root = cos * cos - 4 * k * (angle * sinc) ** 2
    divisor = cos + np.sqrt(np.where(root >= 0, root, np.nan))
    return points * (2 * sinc / np.where(divisor > 0, divisor, np.nan))[:, None]


def _extended_unified(points: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Extended unified camera model: alpha, beta."""
    alpha, beta = coefficients
    angle = np.sqrt((points * points).sum(1))
    cos, sinc = np.cos(angle), np.sinc(angle / math.pi)
    divisor = alpha * np.sqrt(beta * (angle * sinc) ** 2 + cos * cos) + (1 - alpha) * cos
    return points * (sinc / np.where(divisor > 0, divisor, np.nan))[:, None]


MODELS = {
    "pinhole": Model(TANGENT, (0,), _keep),
    "brown": Model(TANGENT, (4, 5, 8, 12, 14), _brown),
    "fisheye": Model(ANGLES, (0, 1, 2, 3, 4), _fisheye),
    "field_of_view": Model(TANGENT, (1,), _field_of_view),
    "thin_prism": Model(TANGENT, (8,), _thin_prism),
    "thin_prism_fisheye": Model(ANGLES, (8,), _thin_prism),
    "project_aria": Model(ANGLES, (12,), _project_aria),
    "division": Model(ANGLES, (1,), _division),
    "extended_unified": Model(ANGLES, (2,), _extended_unified),
}


def to_plane(plane: str, directions: np.ndarray) -> np.ndarray:
    """Map directions in camera axes to a plane, NaN for directions without a point. [N, 3] -> [N, 2]"""
    x, y, z = directions.T
    if plane == TANGENT:
        in_front = z > 1e-9 * np.abs(directions).max(axis=1, initial=0.0)
        return directions[:, :2] / np.where(in_front, z, np.nan)[:, None]
    r = np.hypot(x, y)
    length = np.hypot(r, z)
    angle = np.arctan2(r, np.where(length > 0, z, np.nan))
    factor = np.where(r > 1e-12 * length, angle / np.maximum(r, 1e-300), 1 / np.where(z > 0, z, np.nan))
    return directions[:, :2] * factor[:, None]


def from_plane(plane: str, points: np.ndarray) -> np.ndarray:
    """Map points of a plane to unit directions in camera axes. [N, 2] -> [N, 3]"""
    if plane == TANGENT:
        directions = np.concatenate([points, np.ones((len(points), 1))], 1)
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)
    angle = np.sqrt((points * points).sum(1))
    return np.concatenate([points * np.sinc(angle / math.pi)[:, None], np.cos(angle)[:, None]], 1)

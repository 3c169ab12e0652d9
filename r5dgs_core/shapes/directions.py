"""Evenly distributed directions."""

from __future__ import annotations

import numpy as np


def sphere(count: int) -> np.ndarray:
    """Evenly distributed unit vectors, on a Fibonacci spiral from +z to -z. [count, 3]"""
    number = np.arange(count) + 0.5
    z, angle = 1 - 2 * number / count, np.pi * (1 + 5**0.5) * number
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def circle(count: int) -> np.ndarray:
    """Evenly distributed unit vectors in the plane. [count, 2]"""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)

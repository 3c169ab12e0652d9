"""Placement of labels beside the points of a plot, without overlaps and without hiding a point.

All lengths are in pixels; a box is (left, bottom, right, top).
"""

from __future__ import annotations

import numpy as np

RADII = (7.0, 13.0, 20.0, 30.0, 42.0, 56.0, 72.0, 90.0, 112.0, 138.0, 170.0)  # tried distances, pixels
ANGLES = np.radians([0, 180, 30, 330, 150, 210, 60, 300, 120, 240, 90, 270])  # tried directions, radians
MARGIN = 1.5  # minimum distance between boxes, pixels


def place(
    points: np.ndarray,  # [L, 2]
    sizes: np.ndarray,  # [L, 2]
    frame: np.ndarray,  # [4]
    obstacles: np.ndarray,  # [B, 4]
) -> list[np.ndarray | None]:
    """Place labels in order of priority.

    Args:
        points: Point that each label names. [L, 2]
        sizes: Width and height of each label. [L, 2]
        frame: Box that labels must not leave. [4]
        obstacles: Boxes that labels must not touch, such as the markers of the points. [B, 4]

    Returns:
        Box of each label [4], as near to its point as the earlier labels allow; None if no free place was found.
    """
    taken = np.asarray(obstacles, np.float64).reshape(-1, 4)
    found: list[np.ndarray | None] = []
    for point, size in zip(np.asarray(points, np.float64), np.asarray(sizes, np.float64), strict=True):
        box = next((box for box in _candidates(point, size) if _is_free(box, frame, taken)), None)
        found.append(box)
        if box is not None:
            taken = np.concatenate([taken, box[None]])
    return found


def overlaps(box: np.ndarray, others: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Mask of the boxes [B, 4] that are closer to a box [4] than a margin. [B] bool"""
    apart = (
        (others[:, 0] >= box[2] + margin)
        | (others[:, 2] <= box[0] - margin)
        | (others[:, 1] >= box[3] + margin)
        | (others[:, 3] <= box[1] - margin)
    )
    return ~apart


def _candidates(point: np.ndarray, size: np.ndarray):
    for radius in RADII:
        for angle in ANGLES:
            direction = np.array([np.cos(angle), np.sin(angle)])
            # The side of the box that faces the point is at distance ``radius``.
            center = point + radius * direction + 0.5 * size * np.where(np.abs(direction) > 0.3, np.sign(direction), 0)
            yield np.concatenate([center - 0.5 * size, center + 0.5 * size])


def _is_free(box: np.ndarray, frame: np.ndarray, taken: np.ndarray) -> bool:
    inside = box[0] >= frame[0] and box[1] >= frame[1] and box[2] <= frame[2] and box[3] <= frame[3]
    return bool(inside) and not overlaps(box, taken, MARGIN).any()

"""Recordings of a board that is carried before fixed cameras, with exact poses."""

from __future__ import annotations

import cv2
import numpy as np

from r5dgs_core.capture.calibration.lens import Lens
from tests.support.projections import rotation
from tests.support.room import Film, look_at

SIZE = 640, 480
MATRICES = [np.array([[f, 0, 320.0], [0, f, 240.0], [0, 0, 1]]) for f in (560.0, 600.0, 580.0)]
LENSES = [Lens("pinhole", m[0, 0].item(), m[1, 1].item(), 320.0, 240.0) for m in MATRICES]
POSES = [look_at((x, -0.1 * k, -1.2), (0.0, 0.0, 0.0)) for k, x in enumerate((-0.5, 0.0, 0.45))]
CHARUCO = "charuco:5x4:0.1:0.075:4X4_50"
APRILTAG = "apriltag:3x2:0.14:0.04:36h11"
TIMES = 12


def drawn(kind: str) -> np.ndarray:
    """Picture of a board with a white margin of 40 pixels, 2000 pixels per metre."""
    dictionary = cv2.aruco.DICT_4X4_50 if kind == CHARUCO else cv2.aruco.DICT_APRILTAG_36h11
    markers = cv2.aruco.getPredefinedDictionary(dictionary)
    if kind == CHARUCO:
        return cv2.aruco.CharucoBoard((5, 4), 0.1, 0.075, markers).generateImage((1080, 880), None, 40)
    return cv2.aruco.GridBoard((3, 2), 0.14, 0.04, markers).generateImage((1080, 720), None, 40)


def carried(time: int) -> np.ndarray:
    """Pose of the board, board to world. [4, 4]"""
    world = np.eye(4)
    world[:3, :3] = rotation(50 + time, 0.45)
    world[:3, 3] = 0.12 * np.sin([time, 2.0 * time, 3.0 * time]) - world[:3, :3] @ [0.25, 0.2, 0.0]
    return world


def films(kind: str, times: int = TIMES, unseen: dict[int, set[int]] | None = None) -> list[Film]:
    """Recordings of the board; ``unseen`` lists the times at which a camera sees only the background."""
    picture = drawn(kind)
    to_meters = np.array([[1 / 2000, 0, -0.02], [0, 1 / 2000, -0.02], [0, 0, 1]])
    result = []
    for camera, (matrix, pose) in enumerate(zip(MATRICES, POSES, strict=True)):
        frames = []
        for time in range(times):
            view = np.linalg.inv(pose) @ carried(time)
            plane = matrix @ view[:3, [0, 1, 3]] @ to_meters
            half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV counts from the first pixel's centre
            gray = np.full(SIZE[::-1], 128, np.uint8)
            if time not in (unseen or {}).get(camera, set()):
                gray = cv2.warpPerspective(
                    picture, half @ plane @ np.linalg.inv(half), SIZE, flags=cv2.INTER_AREA, borderValue=128
                )
            frames.append(np.repeat(cv2.GaussianBlur(gray, (3, 3), 0.6)[..., None], 3, axis=2))
        result.append(Film(f"cam{camera}", frames, np.arange(times) / 10))
    return result

"""Sightings of a board: its corners in the frames of all cameras, the lenses that they show, and its poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ... import errors
from ..calibration.lens import Lens
from .board import Detector
from .recording import Recording

MOST_TIMES = 120  # maximum number of times at which boards are searched
FEWEST_CORNERS = 6  # minimum number of corners in a sighting
FEWEST_VIEWS = 6  # minimum number of sightings for a lens
_LENS_VIEWS = 40  # maximum number of sightings for a lens; more take long and change little
_WORST_LENS = 3.0  # px, rms error of a lens
_WORST_POSE = 5.0  # px, rms error of a board's pose


@dataclass(frozen=True, eq=False)
class Sighting:
    """A board in one frame.

    Attributes:
        camera: Index of the camera.
        time: Index of the time.
        rows: Rows of the detector's points. [n]
        pixels: Their positions, the first pixel's centre at 0.5. [n, 2]
    """

    camera: int
    time: int
    rows: np.ndarray
    pixels: np.ndarray


def find(
    recordings: Sequence[Recording], detector: Detector, progress: Callable[[dict[str, Any]], None]
) -> list[Sighting]:
    """Look for a board in frames of all cameras that are nearest to common times.

    Args:
        recordings: The cameras.
        detector: Detector of the board.
        progress: Called with an event after each frame.
    """
    first = max(float(recording.times[0]) for recording in recordings)
    last = min(float(recording.times[-1]) for recording in recordings)
    if first > last:
        raise errors.DatasetError(
            f"recordings {', '.join(r.name for r in recordings)}: expected a common time, found none; check their times"
        )
    count = min(MOST_TIMES, max(len(recording.times) for recording in recordings))
    times = np.linspace(first, last, count)
    frames = []  # time by frame of each camera
    for recording in recordings:
        nearest = np.abs(recording.times[None] - times[:, None]).argmin(1)
        frames.append({int(frame): time for time, frame in reversed(list(enumerate(nearest)))})
    sightings, done, total = [], 0, sum(map(len, frames))
    for camera, (recording, by_frame) in enumerate(zip(recordings, frames, strict=True)):
        for index, pixels in recording.read(sorted(by_frame)):
            rows, corners = detector.detect(pixels)
            done += 1
            progress({"event": "board", "done": done, "total": total, "unit": "frames", "text": recording.name})
            if len(rows) >= FEWEST_CORNERS:
                sightings.append(Sighting(camera, by_frame[index], rows, corners))
    return sightings


def lens(recording: Recording, views: Sequence[Sighting], points: np.ndarray) -> Lens:
    """Estimate the lens of a camera from sightings of a flat board.

    Raises:
        DatasetError: There are too few sightings, or they do not fit one lens.
    """
    import cv2

    if len(views) < FEWEST_VIEWS:
        raise errors.DatasetError(
            f"camera {recording.name!r}: the board is seen in {len(views)} frames, expected {FEWEST_VIEWS} at least. "
            "Remedy: film the board near this camera too, tilted in several ways, or give the lens with --lenses"
        )
    chosen = [views[k] for k in sorted(set(np.linspace(0, len(views) - 1, _LENS_VIEWS).astype(int).tolist()))]
    size = recording.width, recording.height
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_K2  # refined with all cameras together
    start = np.array([[max(size), 0, size[0] / 2 - 0.5], [0, max(size), size[1] / 2 - 0.5], [0, 0, 1.0]])
    error, matrix, coefficients, *_ = cv2.calibrateCamera(
        [points[view.rows].astype(np.float32) for view in chosen],
        [(view.pixels - 0.5).astype(np.float32) for view in chosen],
        size,
        start,
        np.zeros(5),
        flags=flags,
        criteria=(3, 100, 1e-9),
    )
    focal = matrix[0, 0] / max(size)
    if not (error < _WORST_LENS and 0.4 < focal < 3.0):
        raise errors.DatasetError(
            f"camera {recording.name!r}: no lens fits the board (error {error:.1f} px, focal {focal:.2g} widths). "
            "Remedy: check the size of the board, hold it still or use a shorter exposure, and tilt it in several ways"
        )
    return Lens.from_opencv(matrix, [float(k) for k in np.asarray(coefficients).ravel()[:4]])


def board_poses(view: Sighting, points: np.ndarray, lens: Lens) -> list[np.ndarray]:
    """Return poses of the board that explain a sighting, board to camera, the best first. [4, 4] each

    A small flat board has two: tilted one way or the other.
    """
    import cv2

    directions = lens.unproject(view.pixels)
    seen = np.isfinite(directions).all(1) & (directions[:, 2] > 0.05)
    if seen.sum() < 4:
        return []
    flat = directions[seen, :2] / directions[seen, 2:]
    target = points[view.rows[seen]]
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(target, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # corners on one line
        return []
    found = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        miss = lens.project(points[view.rows] @ pose[:3, :3].T + pose[:3, 3]) - view.pixels
        error = float(np.sqrt(np.nanmean((miss**2).sum(1))))
        if np.isfinite(error) and error < _WORST_POSE:
            found.append((error, pose))
    return [pose for _, pose in sorted(found, key=lambda pair: pair[0])]

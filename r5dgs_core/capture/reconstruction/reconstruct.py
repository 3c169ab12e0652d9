"""Reconstruction of the cameras of recordings without a calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import errors
from ..calibration.calibration import CalibratedCamera, Calibration
from . import board_cameras, features, gauge, sightings
from .board import Detector
from .recording import Recording
from .request import Request


def reconstruct(
    recordings: Sequence[Recording],
    request: Request,
    work: Path,
    progress: Callable[[dict[str, Any]], None] = lambda event: None,
) -> Calibration:
    """Reconstruct lens and pose of every camera: from the board if there is one, otherwise from image features.

    The recordings must share a clock, at least roughly, if a board is carried around.

    Args:
        recordings: The cameras.
        request: Known facts about them.
        work: Folder for intermediate files of features; it is emptied.
        progress: Called with events while the board is searched.

    Returns:
        The cameras, in a world with z up.

    Raises:
        ConfigError: A name or option of the request is wrong.
        DatasetError: Cameras cannot be connected; the error names them and the remedy.
        BackendError: OpenCV or pycolmap is not installed, or fails.
    """
    names = [recording.name for recording in recordings]
    unknown = sorted((set(request.moving) | set(request.distance[:2] if request.distance else ())) - set(names))
    if unknown:
        raise errors.ConfigError(f"cameras {', '.join(unknown)}: unknown; the recordings are {', '.join(names)}")
    _check_up(request)
    boards = None
    if request.board is None:
        calibration = features.reconstruct(recordings, request, work)
    else:
        calibration, boards = _from_board(recordings, request, progress)
    if request.distance is not None:
        calibration = gauge.with_distance(calibration, *request.distance)
    return gauge.upright(calibration, request.up, boards)


def _check_up(request: Request) -> None:
    """Raise ConfigError for an up direction that the reconstruction will not give, before its minutes."""
    if request.up == gauge.BOARD and request.board is None:
        raise errors.ConfigError("--up board: expected a board, found none; name it with --board, or use --up cameras")
    if request.up == gauge.PLANE and request.board is not None:
        raise errors.ConfigError("--up plane: needs points, which a board does not give; use --up board or cameras")


def _from_board(
    recordings: Sequence[Recording], request: Request, progress: Callable[[dict[str, Any]], None]
) -> tuple[Calibration, list[np.ndarray]]:
    """Reconstruct fixed cameras from sightings of the board; also returns the board's poses, board to world."""
    assert request.board is not None
    if request.moving:
        raise errors.ConfigError(
            f"--board: expected fixed cameras, found moving ones ({', '.join(sorted(request.moving))}). Remedy: leave "
            "out --board, so that image features are used, or prepare the moving cameras alone"
        )
    detector = Detector(request.board)
    seen = sightings.find(recordings, detector, progress)
    unseen = [r.name for k, r in enumerate(recordings) if not any(s.camera == k for s in seen)]
    if unseen:
        raise errors.DatasetError(
            f"cameras {', '.join(unseen)}: the board was not found in their frames. Remedy: check the board's columns, "
            "rows and dictionary, and film it closer to these cameras, or remove them"
        )
    known = [request.lenses.get(recording.name) for recording in recordings]
    lenses = [
        lens or sightings.lens(recording, [s for s in seen if s.camera == k], detector.points)
        for k, (recording, lens) in enumerate(zip(recordings, known, strict=True))
    ]
    names = [recording.name for recording in recordings]
    solution = board_cameras.solve(names, lenses, seen, detector.points, refine=not all(known))
    cameras = tuple(
        CalibratedCamera(r.name, r.width, r.height, lens, np.linalg.inv(pose))
        for r, lens, pose in zip(recordings, solution.lenses, solution.cameras, strict=True)
    )
    return Calibration(cameras, 1.0, "board", Path()), list(solution.boards.values())

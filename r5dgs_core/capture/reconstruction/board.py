"""Calibration boards: their description, and the detection of their corners with OpenCV."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ... import errors, extras
from ..calibration.formats import numbers

CHARUCO, APRILTAG = "charuco", "apriltag"
_FORM = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY (lengths in metres, for example charuco:4x5:0.054:0.0405:4X4_1000), "
    "apriltag:COLUMNSxROWS:TAG:GAP:FAMILY (for example apriltag:6x6:0.08:0.024:36h11), or caliscope's charuco.toml"
)


@dataclass(frozen=True)
class Board:
    """A board.

    Attributes:
        kind: `CHARUCO` or `APRILTAG`.
        columns: Number of squares or tags in a row.
        rows: Number of squares or tags in a column.
        length: Side of a square or tag in metres.
        detail: Side of a marker of a ChArUco board, or the gap between tags, in metres.
        dictionary: Name of the markers' dictionary in OpenCV, for example "DICT_4X4_1000".
    """

    kind: str
    columns: int
    rows: int
    length: float
    detail: float
    dictionary: str


def parse(text: str) -> Board:
    """Read the description of a board, or caliscope's ``charuco.toml``.

    Raises:
        ConfigError: The description has another form, or values that no board can have.
        DatasetError: The file is damaged.
    """
    if text.lower().endswith(".toml"):
        return _caliscope(Path(text))
    match = re.fullmatch(r"(charuco|apriltag):(\d{1,3})x(\d{1,3}):([\d.]+):([\d.]+):(?:DICT_)?(\w+)", text.strip())
    try:
        if match is None:
            raise ValueError
        kind, columns, rows, length, detail, dictionary = match.groups()
        name = f"DICT_{'APRILTAG_' if kind == APRILTAG and not dictionary.startswith('APRILTAG') else ''}{dictionary}"
        return _checked(Board(kind, int(columns), int(rows), float(length), float(detail), name), text)
    except ValueError as error:
        raise errors.ConfigError(f"--board {text}: expected {_FORM}") from error


def _checked(board: Board, place: str) -> Board:
    smallest = 2 if board.kind == CHARUCO else 1
    if min(board.columns, board.rows) < smallest or not (board.length > 0 and board.detail > 0):
        raise errors.ConfigError(f"{place}: expected positive lengths and a board of {smallest} rows at least")
    if board.kind == CHARUCO and board.detail >= board.length:
        raise errors.ConfigError(f"{place}: expected markers that are smaller than their squares")
    return board


def _caliscope(path: Path) -> Board:
    table, place = numbers.toml(path), str(path)
    columns, rows, length, share = (
        numbers.number(place, table, key) for key in ("columns", "rows", "square_size_override_cm", "aruco_scale")
    )
    dictionary = str(table.get("dictionary", ""))
    return _checked(Board(CHARUCO, int(columns), int(rows), length / 100, share * length / 100, dictionary), place)


class Detector:
    """Finds the corners of a board in images.

    Args:
        board: The board.

    Attributes:
        points: Corners in the board's frame, x along the rows, z into the board, metres. [K, 3]

    Raises:
        BackendError: OpenCV is not installed.
        ConfigError: OpenCV has no such dictionary, or too few markers in it.
    """

    def __init__(self, board: Board) -> None:
        with extras.required("detection of a board", "prepare"):
            import cv2
        names = {name.upper(): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
        if board.dictionary.upper() not in names:
            raise errors.ConfigError(
                f"board: unknown dictionary {board.dictionary}; known are {', '.join(sorted(names.values()))}"
            )
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, names[board.dictionary.upper()]))
        parameters = cv2.aruco.DetectorParameters()
        parameters.detectInvertedMarker = True
        refinement = cv2.aruco.CORNER_REFINE_SUBPIX if board.kind == CHARUCO else cv2.aruco.CORNER_REFINE_APRILTAG
        parameters.cornerRefinementMethod = refinement
        self.board = board
        size = board.columns, board.rows
        needed = board.columns * board.rows // (2 if board.kind == CHARUCO else 1)
        if needed > len(dictionary.bytesList):
            raise errors.ConfigError(f"board: {board.dictionary} has fewer than the {needed} markers of the board")
        if board.kind == CHARUCO:
            made = cv2.aruco.CharucoBoard(size, board.length, board.detail, dictionary)
            self._charuco = cv2.aruco.CharucoDetector(made)
            self._charuco.setDetectorParameters(parameters)
            self.points = np.asarray(made.getChessboardCorners(), np.float64)
        else:
            made = cv2.aruco.GridBoard(size, board.length, board.detail, dictionary)
            self._markers = cv2.aruco.ArucoDetector(dictionary, parameters)
            self.points = np.asarray(made.getObjPoints(), np.float64).reshape(-1, 3)

    def detect(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find corners in an image.

        Args:
            pixels: sRGB. [H, W, 3] uint8

        Returns:
            Rows of `points` [n], and pixels, the first pixel's centre at 0.5 [n, 2].
        """
        import cv2

        gray = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY)
        if self.board.kind == CHARUCO:
            corners, ids, _, _ = self._charuco.detectBoard(gray)
            if ids is None:
                return np.zeros(0, int), np.zeros((0, 2))
            return ids.ravel().astype(int), np.asarray(corners, np.float64).reshape(-1, 2) + 0.5
        corners, ids, _ = self._markers.detectMarkers(gray)
        if ids is None:
            return np.zeros(0, int), np.zeros((0, 2))
        found = [
            (tag, corner)
            for tag, corner in zip(ids.ravel().tolist(), corners, strict=True)
            if 4 * tag < len(self.points)
        ]
        # This refinement counts the first pixel's centre as 0.5 (measured); that of ChArUco corners counts it as 0.
        rows = np.array([4 * tag + k for tag, _ in found for k in range(4)], int)
        return rows, np.array([corner.reshape(4, 2) for _, corner in found], np.float64).reshape(-1, 2)

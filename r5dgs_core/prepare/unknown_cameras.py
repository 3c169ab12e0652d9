"""Cameras of recordings without a calibration: reconstructed once, and kept in the data set for later runs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import errors
from ..capture.calibration import reading
from ..capture.calibration.formats import r5dgs_json
from ..capture.calibration.lens import Lens
from ..capture.reconstruction import board
from ..capture.reconstruction import reconstruct as reconstruction
from ..capture.reconstruction.request import Request
from . import cameras, names, source_files
from .camera_source import CameraSource

FILE = r5dgs_json.FILES
WORK = "reconstruction"  # folder of intermediate files


@dataclass(frozen=True)
class UnknownCameras:
    """Known facts about cameras without a calibration.

    Attributes:
        board: Description of a board in the recordings (`board.parse`), or None.
        moving: Names of the cameras that move; a single camera always does.
        shared_lens: All cameras have one lens.
        lenses: Calibration that gives the lenses, but not the poses, or None.
        distance: Names of two cameras and their distance in metres, or None.
    """

    board: str | None = None
    moving: tuple[str, ...] = ()
    shared_lens: bool = False
    lenses: Path | None = None
    distance: tuple[str, str, float] | None = None


def missing(source: Path, calibration: Path | None) -> bool:
    """Return True if the cameras of a source must be reconstructed."""
    folder = source if source.is_dir() else source.parent
    return calibration is None and folder.exists() and reading.find_calibration(folder) is None


def fit(source: Path, out: Path, recordings: dict[str, str]) -> bool:
    """Return True if the file of the cameras in ``out`` is missing, or made from the recordings of a source.

    Args:
        source: Folder of videos or frames, or one video.
        out: Folder of the data set.
        recordings: Fingerprints of the data set's recordings, for files of older releases, which have none.

    Raises:
        DatasetError: The source has no recordings, or the file is damaged.
    """
    path = out / FILE
    return not path.is_file() or (r5dgs_json.read_recordings(path) or recordings) == _fingerprints(source)


def _fingerprints(source: Path) -> dict[str, str]:
    return {camera.name: source_files.fingerprint(camera.paths) for camera in source_files.find(Path(source))}


def reconstruct(
    source: Path,
    out: Path,
    known: UnknownCameras,
    up: str | None,
    *,
    rate: float | None,
    again: bool,
    progress: Callable[[dict[str, Any]], None],
) -> Path:
    """Return the file of the cameras in ``out``; reconstruct them unless it exists.

    Args:
        source: Folder of videos or frames, or one video.
        out: Folder of the data set.
        known: Known facts about the cameras.
        up: Up of the world (`gauge.upright`); that of the cameras if None.
        rate: Frames per second of recordings without usable times, or None.
        again: Replace an existing file.
        progress: Called with progress events.

    Raises:
        ConfigError, DatasetError, BackendError: Cameras cannot be reconstructed; the error names them.
    """
    path = out / FILE
    if path.is_file() and not again:
        return path
    recordings = _fingerprints(source)  # before the minutes in which the user may replace a file
    sources = cameras.open_sources(source, rate)
    moving = frozenset(known.moving) or frozenset(one.name for one in sources if len(sources) == 1)
    request = Request(
        moving=moving,
        shared_lens=known.shared_lens,
        lenses=_lenses(known.lenses, sources),
        board=None if known.board is None else board.parse(known.board),
        distance=known.distance,
        up=up or "cameras",
    )
    text = "cameras from the board" if request.board else "cameras from image features; this can take minutes"
    progress({"event": "read", "text": text})
    found = reconstruction.reconstruct(sources, request, out / WORK, progress)
    r5dgs_json.write(path, found, recordings)
    shutil.rmtree(out / WORK, ignore_errors=True)
    return path


def _lenses(path: Path | None, sources: list[CameraSource]) -> dict[str, Lens]:
    """Return the lens of each recording by a calibration of the same names."""
    if path is None:
        return {}
    calibration = reading.read_calibration(path)
    by_name = {camera.name: camera for camera in calibration.cameras}
    matched = names.match([one.name for one in sources], list(by_name))
    if matched is None:
        raise errors.DatasetError(
            f"{calibration.path}: expected lenses of {', '.join(one.name for one in sources)}, found those of "
            f"{', '.join(by_name)}; give recordings and cameras the same names"
        )
    return {one.name: by_name[matched[one.name]].resized(one.width, one.height).lens for one in sources}

"""The cameras of a source: files, times, lenses and poses together."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import errors
from ..capture.calibration import reading
from ..capture.calibration.calibration import CalibratedCamera, CalibratedFrame, Calibration
from ..capture.calibration.lens import Lens
from ..capture.reconstruction import gauge
from . import camera_source, frame_times, names, source_files
from .camera_source import FRAME_RATE, CameraSource


@dataclass(frozen=True)
class Camera:
    """A camera with its recording.

    Attributes:
        source: The recording.
        calibrated: Its lens and pose, for the size of the frames.
        usable: Indices of the frames that have a pose, increasing.
        frames: Lens and pose of each usable frame, if they change; else empty.
    """

    source: CameraSource
    calibrated: CalibratedCamera
    usable: np.ndarray
    frames: tuple[CalibratedFrame, ...] = ()

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.source.name

    def pose(self, index: int) -> np.ndarray:
        """Return camera to world of a frame, OpenCV axes. [4, 4]"""
        return self._at(index).camera_to_world

    def lens(self, index: int) -> Lens:
        """Return the lens of a frame, for its size."""
        return self._at(index).lens

    def _at(self, index: int) -> CalibratedFrame | CalibratedCamera:
        return self.frames[int(np.searchsorted(self.usable, index))] if self.frames else self.calibrated


def open_all(
    source: Path,
    calibration_path: Path | None,
    rate: float | None,
    up: str | None = None,
    meters_per_unit: float | None = None,
) -> tuple[list[Camera], Calibration]:
    """Open the cameras of a source and their calibration.

    Args:
        source: Folder of videos or frames, or one video.
        calibration_path: File or folder of the calibration; that in the source's folder if None.
        rate: Frames per second of recordings without usable times, or None.
        up: Up of the world that replaces that of the calibration (`gauge.upright`), or None.
        meters_per_unit: Scale of the world that replaces that of the calibration, or None.

    Raises:
        DatasetError: A file is missing or damaged, or the calibration does not fit the cameras.
        BackendError: A package is missing.
    """
    source = Path(source)
    calibration = _adjusted(_calibration(source, calibration_path), up, meters_per_unit)
    opened: list[tuple[CameraSource, CalibratedCamera]]
    try:
        files = source_files.find(source)
        matched = _matched(calibration, [camera.name for camera in files])
    except errors.DatasetError:
        listed = [camera for camera in calibration.cameras if any(frame.path.is_file() for frame in camera.frames)]
        if not listed:
            raise
        opened = [(_of_calibration(camera, calibration, rate), camera) for camera in listed]
    else:
        opened = [(camera_source.open_camera(camera, rate), matched[camera.name]) for camera in files]
    sources = _timed(source, [one for one, _ in opened], rate)
    return [_with_poses(one, camera) for one, (_, camera) in zip(sources, opened, strict=True)], calibration


def open_sources(source: Path, rate: float | None) -> list[CameraSource]:
    """Open the recordings of a source without a calibration."""
    files = source_files.find(Path(source))
    return _timed(Path(source), [camera_source.open_camera(camera, rate) for camera in files], rate)


def _timed(source: Path, sources: list[CameraSource], rate: float | None) -> list[CameraSource]:
    """Return recordings with the times of ``timestamps.csv``, if there is one."""
    folder = source if source.is_dir() else source.parent
    if (folder / frame_times.FILE).is_file() and rate is None:
        return frame_times.apply(sources, folder / frame_times.FILE)
    return sources


def _calibration(source: Path, path: Path | None) -> Calibration:
    if path is not None:
        return reading.read_calibration(path)
    folder = source if source.is_dir() else source.parent
    if reading.find_calibration(folder) is None:
        raise errors.DatasetError(
            f"{folder}: expected the cameras' calibration among the recordings, found none. Remedy: name its file or "
            "folder with --calibration (docs/reference/calibrations.md lists the formats)"
        )
    return reading.read_calibration(folder)


def _adjusted(calibration: Calibration, up: str | None, meters_per_unit: float | None) -> Calibration:
    if up is not None:
        calibration = gauge.upright(calibration, up)
    return calibration if meters_per_unit is None else replace(calibration, meters_per_unit=meters_per_unit)


def _matched(calibration: Calibration, recordings: Sequence[str]) -> dict[str, CalibratedCamera]:
    """Return the calibrated camera of each recording."""
    by_name = {camera.name: camera for camera in calibration.cameras}
    found = names.match(recordings, list(by_name))
    if found is None and len(by_name) == len(recordings) == 1:
        found = {recordings[0]: next(iter(by_name))}
    if found is None:
        without = names.unmatched(recordings, list(by_name))
        raise errors.DatasetError(
            f"{calibration.path}: expected the cameras {', '.join(recordings)}, found {', '.join(by_name)}; no camera "
            f"matches {', '.join(without)}. Remedy: give recordings and calibrated cameras the same names, remove "
            "recordings that are not calibrated, or name the calibration of these cameras with --calibration"
        )
    return {recording: by_name[name] for recording, name in found.items()}


def _of_calibration(camera: CalibratedCamera, calibration: Calibration, rate: float | None) -> CameraSource:
    """Open the images that a calibration lists for a camera."""
    frames = [frame for frame in camera.frames if frame.path.is_file()]
    times = np.array([np.nan if frame.time is None else frame.time for frame in frames])
    timing = "calibration"
    if np.isfinite(times).all() and len(np.unique(times)) == len(times):
        order = np.argsort(times, kind="stable")
        times = times[order]
        if calibration.seconds_per_time is not None and rate is None:
            times = times * calibration.seconds_per_time
        elif len(times) > 1:
            times = (times - times[0]) / float(np.median(np.diff(times))) / (rate or FRAME_RATE)
        frames = [frames[k] for k in order]
    else:
        frames = sorted(frames, key=lambda frame: source_files.natural(frame.path.name))
        times, timing = np.arange(len(frames)) / (rate or FRAME_RATE), camera_source.RATE
    files = source_files.CameraFiles(camera.name, source_files.FRAMES, tuple(frame.path for frame in frames))
    return replace(camera_source.open_camera(files, rate or FRAME_RATE), times=times, timing=timing)


def _with_poses(source: CameraSource, calibrated: CalibratedCamera) -> Camera:
    """Join a recording and its calibrated camera; finds the pose and lens of each frame if they change."""
    calibrated = calibrated.resized(source.width, source.height)
    if not calibrated.changes:
        return Camera(source, calibrated, np.arange(len(source.times)))
    by_index = _frames_by_index(source, calibrated.frames)
    if not by_index:
        raise errors.DatasetError(
            f"camera {source.name!r}: its pose or lens changes, but the calibration names none of its frames; expected "
            f"names such as {source.frame_name(0)}"
        )
    usable = np.array(sorted(by_index))
    frames = tuple(by_index[index] for index in usable.tolist())
    lost = len(source.times) - len(usable)
    if lost:
        source = replace(source, notes=(*source.notes, f"{lost} frames have no pose and are left out"))
    return Camera(source, calibrated, usable, frames)


def _frames_by_index(source: CameraSource, frames: Sequence[CalibratedFrame]) -> dict[int, CalibratedFrame]:
    """Find the entry of each frame by its file's name, or, for a video, by order or number."""
    if not source.videos:
        by_path = {frame.path.resolve(): frame for frame in frames}
        by_stem = {frame.path.stem: frame for frame in frames}
        found = {k: by_path.get(path.resolve(), by_stem.get(path.stem)) for k, path in enumerate(source.paths)}
        return {k: frame for k, frame in found.items() if frame is not None}
    ordered = sorted(frames, key=lambda frame: source_files.natural(frame.path.stem))
    if len(ordered) == len(source.times):
        return dict(enumerate(ordered))
    numbers = [re.findall(r"\d+", frame.path.stem) for frame in ordered]
    if not all(numbers):
        return {}
    indices = [int(digits[-1]) for digits in numbers]
    first = 0 if 0 in indices else 1  # programs that extract frames count from 0 or from 1
    pairs = zip(indices, ordered, strict=True)
    return {index - first: frame for index, frame in pairs if index - first < len(source.times)}

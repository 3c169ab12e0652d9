"""Common clock of the cameras: known offsets, sound, or motion.

Measured offsets are used only if one of them is significant. Cameras that record in step have offset 0, and a
measurement would only add its error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors
from ..capture.calibration.calibration import CalibratedCamera, Calibration
from ..data import mask_notes, masks
from . import audio_offsets, clock, frame_masks, motion_offsets, motion_tracks
from .camera_source import TABLE, CameraSource
from .clock import Offset
from .motion_tracks import MotionTrack

METHODS = ("auto", "audio", "motion", "none")
SIGNIFICANT = 3.0  # least offset, in standard deviations
GAIN = 0.05  # least reduction of the loss by offsets from motion
UNSURE = 0.5  # largest standard deviation of a usable offset, frame intervals


def offsets(
    sources: Sequence[CameraSource],
    calibration: Calibration,
    cameras: Sequence[CalibratedCamera],
    method: str,
    given: Mapping[str, float],
    progress: Callable[[dict[str, Any]], None],
    mask_folder: Path | None = None,
) -> tuple[list[Offset], list[str]]:
    """Return the offset of each camera's clock, and remarks for the user.

    Args:
        sources: The cameras.
        calibration: The calibration.
        cameras: Their calibrated cameras, for the size of their frames.
        method: One of `METHODS`.
        given: Known offsets in seconds by name; other cameras then have offset 0.
        progress: Called with progress events.
        mask_folder: Masks of the frames, whose objects are compared instead of the largest moving region.

    Raises:
        ConfigError: A given name does not exist, or the method cannot be used.
    """
    names = [source.name for source in sources]
    unknown = [name for name in given if name not in names]
    if unknown:
        raise errors.ConfigError(f"--offset {unknown[0]}: expected one of {', '.join(names)}")
    none = [Offset(0.0, None, "none") for _ in sources]
    if given:
        return [Offset(given.get(name, 0.0), 0.0, "given") for name in names], []
    if len(sources) < 2 or method == "none":
        return none, []
    if method == "auto" and all(source.timing == TABLE for source in sources):
        return [Offset(0.0, clock.irregularity(source.times), TABLE) for source in sources], []
    if method in ("auto", "audio"):
        if all(source.sound for source in sources):
            progress({"event": "sync", "text": "sound"})
            found = audio_offsets.measure(sources, _distances(cameras, calibration.meters_per_unit))
            if found is not None and all(one.sigma is not None for one in found):
                return _significant(sources, found)
        elif method == "audio":
            silent = next(source.name for source in sources if not source.sound)
            raise errors.ConfigError(f"--sync audio: {silent} has no sound; use --sync motion")
        if method == "audio":
            raise errors.ConfigError("--sync audio: the cameras' sounds do not match; use --sync motion")
    if any(camera.changes for camera in cameras):
        return none, ["clocks are not compared, because a camera moves or zooms; give offsets with --offset NAME=MS"]
    return _by_motion(sources, cameras, progress, mask_folder)


def _by_motion(
    sources: Sequence[CameraSource],
    cameras: Sequence[CalibratedCamera],
    progress: Callable[[dict[str, Any]], None],
    folder: Path | None,
) -> tuple[list[Offset], list[str]]:
    poses = [camera.T_cam_world for camera in cameras]
    intervals = [source.interval for source in sources]
    tracks = [] if folder is None else _masked_tracks(sources, cameras, folder)
    found = motion_offsets.measure(tracks, poses, intervals)
    if found is None:
        tracks = _moving_regions(sources, cameras, progress)
        found = motion_offsets.measure(tracks, poses, intervals)
    none = [Offset(0.0, None, "none") for _ in sources]
    if found is None:
        return none, ["clocks are not compared: too little moves in the cameras' common view; offsets of 0 are used"]
    values = np.array([one.seconds for one in found])
    before = motion_offsets.misfit(tracks, poses, max(intervals), 0 * values)
    after = motion_offsets.misfit(tracks, poses, max(intervals), values)
    if np.isfinite(before) and after > (1 - GAIN) * before:
        return [Offset(0.0, one.sigma, one.method) for one in found], []
    return _significant(sources, found)


def _masked_tracks(
    sources: Sequence[CameraSource], cameras: Sequence[CalibratedCamera], folder: Path
) -> list[dict[int, MotionTrack]]:
    """Return the paths of the objects of masks; none if their ids are not those of the scene."""
    notes, files = mask_notes.read(folder), frame_masks.find(folder, sources)
    if notes.numbering != mask_notes.SCENE:
        return []
    colors = masks.color_table([path for found in files for path in found.values()])

    def read(path: Path) -> np.ndarray:
        return masks.read(path, colors, notes.unknown)

    return [
        motion_tracks.of_masks(source, camera.lens, found, read)
        for source, camera, found in zip(sources, cameras, files, strict=True)
    ]


def _moving_regions(
    sources: Sequence[CameraSource], cameras: Sequence[CalibratedCamera], progress: Callable[[dict[str, Any]], None]
) -> list[dict[int, MotionTrack]]:
    """Return the path of the largest moving region of each camera."""
    total = sum(min(len(source.times), motion_tracks.MOST_FRAMES) for source in sources)
    done, tracks = 0, []
    for source, camera in zip(sources, cameras, strict=True):

        def report(count: int, before: int = done, name: str = source.name) -> None:
            event = {"event": "sync", "done": before + count, "total": total, "unit": "frames"}
            progress({**event, "text": f"motion in {name}"})

        tracks.append({0: motion_tracks.track(source, camera.lens, report)})
        done += min(len(source.times), motion_tracks.MOST_FRAMES)
    return tracks


def _significant(sources: Sequence[CameraSource], found: Sequence[Offset]) -> tuple[list[Offset], list[str]]:
    """Replace all offsets by 0 if none is significant; returns them, and a remark for each that was not measured.

    Cameras that were not measured get the median of the others, as the first camera may be far from it.
    """
    pairs = list(zip(sources, found, strict=True))
    measured = [one for source, one in pairs if one.sigma is not None and one.sigma <= UNSURE * source.interval]
    used = any(one.sigma and abs(one.seconds) >= SIGNIFICANT * one.sigma for one in measured)
    usual = float(np.median([one.seconds for one in measured])) if used else 0.0
    result, notes = [], []
    for source, one in pairs:
        if one in measured:
            result.append(one if used else Offset(0.0, one.sigma, one.method))
        else:
            result.append(Offset(usual, None, "none"))
            text = f"{source.name}: its clock could not be compared with the others; "
            notes.append(text + (f"their median {1e3 * usual:+.1f} ms is used" if usual else "offset 0 is used"))
    return result, notes


def _distances(cameras: Sequence[CalibratedCamera], meters_per_unit: float | None) -> np.ndarray | None:
    """Distances between cameras, metres; None if the unit is unknown. [C, C]"""
    if meters_per_unit is None:
        return None
    centers = np.stack([camera.camera_to_world[:3, 3] for camera in cameras])
    return np.linalg.norm(centers[:, None] - centers[None], axis=-1) * meters_per_unit

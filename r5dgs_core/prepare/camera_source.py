"""A camera of the source: its size, the times of its frames on its own clock, and its pixels, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import errors
from . import frame_file, video_file
from .source_files import VIDEO, CameraFiles
from .video_file import VideoFile

FRAME_RATE = 30.0  # of folders of frames without times, Hz
_TRUNCATED = 1  # number of missing frames that rounding in the container may explain


@dataclass(frozen=True)
class CameraSource:
    """A camera of the source.

    Attributes:
        name: Its name.
        paths: Its chapters or frames.
        width: Width of the upright frames, pixels.
        height: Height of the upright frames, pixels.
        times: Time of each frame on the camera's clock, seconds, increasing. [F]
        timing: Origin of the times, `CONTAINER`, `TABLE` or `RATE`.
        videos: The chapters; empty for frames.
        first: Index of the first frame of each chapter; empty for frames.
        notes: Remarks for the user and for ``capture.json``.
    """

    name: str
    paths: tuple[Path, ...]
    width: int
    height: int
    times: np.ndarray
    timing: str
    videos: tuple[VideoFile, ...] = ()
    first: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def interval(self) -> float:
        """Median time between two frames, seconds."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 1.0 / FRAME_RATE

    @property
    def sound(self) -> bool:
        """True if its videos have sound."""
        return bool(self.videos) and all(video.sound for video in self.videos)

    def frame_name(self, index: int) -> str:
        """Return the name of a frame in the data set: that of its file, or its number."""
        return f"{index:06d}" if self.videos else self.paths[index].stem

    def read(self, wanted: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield index and sRGB pixels [H, W, 3] uint8 of frames in order; leaves out frames that cannot be decoded.

        Args:
            wanted: Indices, increasing.
        """
        if not self.videos:
            for index in wanted:
                yield index, self._checked(index, frame_file.read(self.paths[index]))
            return
        ends = (*self.first[1:], len(self.times))
        for video, begin, end in zip(self.videos, self.first, ends, strict=True):
            for index, pixels in video_file.read(video, [i - begin for i in wanted if begin <= i < end]):
                yield begin + index, self._checked(begin + index, pixels)

    def _checked(self, index: int, pixels: np.ndarray) -> np.ndarray:
        if pixels.shape[:2] != (self.height, self.width):
            place = self.paths[0] if self.videos else self.paths[index]
            raise errors.DatasetError(
                f"{place}: expected frames of {self.width}x{self.height}, found {pixels.shape[1]}x{pixels.shape[0]} in "
                f"frame {index}; give all frames of a camera the same size"
            )
        return pixels


CONTAINER, TABLE, RATE = "container", "timestamps.csv", "rate"


def open_camera(files: CameraFiles, rate: float | None = None) -> CameraSource:
    """Open a camera and read the times of its frames.

    Args:
        files: Its files.
        rate: Frames per second that replace the times of a video, and that folders of frames need.

    Raises:
        DatasetError: A file is damaged, or chapters differ in size.
        BackendError: A package is missing.
    """
    source = _open_videos(files) if files.kind == VIDEO else _open_frames(files)
    if rate is not None:
        source = replace(source, times=np.arange(len(source.times)) / rate, timing=RATE)
    elif not source.videos:
        note = f"frames have no times: {FRAME_RATE:g} frames per second assumed; give --rate or timestamps.csv"
        source = replace(source, notes=(*source.notes, note))
    return source


def _open_frames(files: CameraFiles) -> CameraSource:
    by_name: dict[str, Path] = {}
    for path in files.paths:
        other = by_name.setdefault(path.stem, path)
        if other is not path:
            raise errors.DatasetError(
                f"{path}: two frames of {files.name} have the name {path.stem}, the other is {other}; keep one of them"
            )
    width, height = frame_file.size(files.paths[0])
    times = np.arange(len(files.paths)) / FRAME_RATE
    return CameraSource(files.name, files.paths, width, height, times, RATE)


def _open_videos(files: CameraFiles) -> CameraSource:
    videos = tuple(video_file.probe(path) for path in files.paths)
    leading = videos[0]
    notes = [note for video in videos for note in _notes(video)]
    parts, first, start, count = [], [], 0.0, 0
    for video in videos:
        if (video.width, video.height) != (leading.width, leading.height):
            raise errors.DatasetError(
                f"{video.path}: expected {leading.width}x{leading.height} like {leading.path.name}, found "
                f"{video.width}x{video.height}; chapters of one recording have one size"
            )
        own = video.times if not parts else start + video.times - video.times[0]
        parts.append(own)
        first.append(count)
        count += len(own)
        start = own[-1] + (float(np.median(np.diff(own))) if len(own) > 1 else 1.0 / FRAME_RATE)
    if len(videos) > 1:
        notes.append(f"{len(videos)} chapters joined: {', '.join(path.name for path in files.paths)}")
    return CameraSource(
        name=files.name,
        paths=files.paths,
        width=leading.width,
        height=leading.height,
        times=np.concatenate(parts),
        timing=CONTAINER,
        videos=videos,
        first=tuple(first),
        notes=tuple(notes),
    )


def _notes(video: VideoFile) -> list[str]:
    """Remarks about a video."""
    notes = []
    if video.color is not None:
        how = "tone-mapped to sRGB" if video.color.transfer else "converted to sRGB"
        notes.append(f"{video.path.name}: {video.color.label}, {how}")
    if video.turns:
        notes.append(f"{video.path.name}: turned by {90 * video.turns} degrees, according to its metadata")
    if video.declared - len(video.pts) > _TRUNCATED:
        notes.append(
            f"{video.path.name}: the file ends early, with {len(video.pts)} of {video.declared} frames; copy it again "
            "if the end is needed"
        )
    return notes

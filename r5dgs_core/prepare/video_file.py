"""Video files: properties, times of the frames, and decoding with PyAV, frame by frame."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, extras
from . import wide_color

_LAST_FRAME = 0.5  # time that the last frame of a variable rate may be shown, s


@dataclass(frozen=True)
class VideoFile:
    """Result of `probe`.

    Attributes:
        path: The file.
        width: Width after rotation, pixels.
        height: Height after rotation, pixels.
        turns: Counter-clockwise quarter turns that make frames upright, from its metadata.
        codec: Name of the codec.
        pts: Time stamp of each frame in units of ``time_base``, increasing. [F] int64
        time_base: Seconds per unit.
        declared: Number of frames according to the container, 0 if unknown.
        sound: True if the file has sound.
        color: Conversion to sRGB, or None.
        matrix_known: True if the file states its colour matrix.
    """

    path: Path
    width: int
    height: int
    turns: int
    codec: str
    pts: np.ndarray
    time_base: float
    declared: int
    sound: bool
    color: wide_color.Conversion | None
    matrix_known: bool

    @property
    def times(self) -> np.ndarray:
        """Time of each frame on the file's clock, seconds. [F]"""
        return self.pts * self.time_base


def probe(path: Path) -> VideoFile:
    """Read the properties of a video and the times of its frames, decoding only the first frame.

    Raises:
        DatasetError: The file is damaged, has no frames, or is interlaced.
        BackendError: PyAV is missing.
    """
    with _opened(path) as container:
        stream = _stream(container, path)
        first = _first_frame(container, stream, path)
        if first.interlaced_frame:
            raise errors.DatasetError(
                f"{path}: the video is interlaced, so its frames mix two times. Remedy: deinterlace it, for example "
                f"with 'ffmpeg -i {path.name} -vf bwdif -crf 12 {path.stem}_progressive.mp4'"
            )
        container.seek(stream.start_time or 0, stream=stream)
        stamps, base = _stamps(container, stream, path)
        turns = round(first.rotation / 90) % 4
        size = (first.height, first.width) if turns % 2 else (first.width, first.height)
        return VideoFile(
            path=path,
            width=size[0],
            height=size[1],
            turns=turns,
            codec=stream.codec_context.name,
            pts=stamps,
            time_base=base,
            declared=int(stream.frames) or _declared(stream.metadata.get("DURATION", ""), stamps * base),
            sound=bool(container.streams.audio),
            color=wide_color.of(int(first.color_trc), int(first.color_primaries)),
            matrix_known=int(first.colorspace) not in (0, 2),
        )


def read(video: VideoFile, wanted: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Decode frames of a video in order.

    Args:
        video: The video.
        wanted: Indices of the frames, increasing.

    Yields:
        Index and sRGB pixels [H, W, 3] uint8, upright. Frames that cannot be decoded are left out.
    """
    by_stamp = {int(video.pts[index]): index for index in wanted}
    if not by_stamp:
        return
    last = max(by_stamp)
    with _opened(video.path) as container:
        stream = _stream(container, video.path)
        stream.thread_type = "AUTO"
        container.seek(min(by_stamp), stream=stream, backward=True)
        for frame in _frames(container, stream):
            index = None if frame.pts is None else by_stamp.get(frame.pts)
            if index is not None:
                yield index, _pixels(frame, video)
            if frame.pts is not None and frame.pts >= last:
                return


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """Decode frames; after a damaged one, go on with the next key frame. The caller reports missing frames."""
    av = _library()
    packets, damaged = container.demux(stream), False
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            return  # the file ends early
        if packet is None:
            return
        try:
            decoded = packet.decode()
        except av.error.FFmpegError:
            damaged = True
            continue
        for frame in decoded:
            damaged = frame.is_corrupt or damaged and not frame.key_frame
            if not damaged:
                yield frame


def _pixels(frame: Any, video: VideoFile) -> np.ndarray:
    """Return the sRGB pixels of a frame, upright. [H, W, 3] uint8"""
    if video.color is None:
        pixels = frame.to_ndarray(format="rgb24")
    else:
        pixels = video.color.apply(frame.to_ndarray(format="rgb48le"))
    return np.ascontiguousarray(np.rot90(pixels, video.turns)) if video.turns else pixels


def _library() -> Any:
    with extras.required("videos", "video"):
        import av
    return av


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    av = _library()
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise errors.DatasetError(
            f"{path}: the video cannot be opened ({error.strerror or error}). Remedy: copy it again; a recording that "
            "was cut off may need the repair of the camera or of 'untrunc'"
        ) from error
    with container:
        yield container


def _stream(container: Any, path: Path) -> Any:
    pictures = [s for s in container.streams.video if not int(s.disposition) & 0x400]  # 0x400: a cover picture
    if not pictures:
        found = "sound only" if container.streams.audio else "no picture and no sound"
        raise errors.DatasetError(f"{path}: expected a video, found {found}; remove the file from the folder")
    return pictures[0]


def _first_frame(container: Any, stream: Any, path: Path) -> Any:
    av = _library()
    try:
        return next(container.decode(stream))
    except (StopIteration, av.error.FFmpegError) as error:
        raise errors.DatasetError(
            f"{path}: the camera has no frames that can be decoded; copy the video again or remove it"
        ) from error


def _declared(duration: str, times: np.ndarray) -> int:
    """Return the number of frames by the duration in the tags of a Matroska file, 0 if unknown.

    The tag NUMBER_OF_FRAMES is not used, because programs that cut videos keep that of the whole one.

    Args:
        duration: Duration, such as "00:00:01.500000000", or "".
        times: Times of the frames that the file has, s. [F]
    """
    found = re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", duration)
    if found is None or len(times) < 2:
        return 0
    hours, minutes, seconds = map(float, found.groups())
    steps, left = np.diff(times), 3600 * hours + 60 * minutes + seconds - times[-1]
    if left <= max(_LAST_FRAME, 2 * steps.max()):
        return len(times)
    return len(times) + round(left / float(np.median(steps))) - 1


def _stamps(container: Any, stream: Any, path: Path) -> tuple[np.ndarray, float]:
    """Read the time stamps of all frames from the packets. Returns them, and the seconds per unit."""
    av = _library()
    found: list[int] = []
    try:
        for packet in container.demux(stream):
            if packet.size and packet.pts is not None and not packet.is_discard:
                found.append(packet.pts)
    except av.error.FFmpegError:
        pass  # the file ends early; `declared` shows by how much
    if not found:
        raise errors.DatasetError(
            f"{path}: the video has no time stamps. Remedy: store it in a container that has them, for example with "
            f"'ffmpeg -r RATE -i {path.name} -c copy {path.stem}.mp4'"
        )
    return np.unique(np.array(found, np.int64)), float(stream.time_base)

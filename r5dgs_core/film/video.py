"""Videos by PyAV: H.264 in .mp4, ProRes 4444 in .mov and VP9 in .webm, the last two with alpha if requested.

Pictures are converted to BT.709 YUV of limited range, and files are tagged: primaries and matrix BT.709, transfer sRGB.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, errors, extras

BT709, SRGB, LIMITED = 1, 13, 1  # codes of ITU-T H.273, and of FFmpeg for the range
MAX_DENOMINATOR = 1001  # of the frame rate


@dataclass(frozen=True)
class Codec:
    """Codec of a container.

    Attributes:
        name: FFmpeg's name of the encoder.
        opaque: Pixel format without alpha.
        alpha: Pixel format with alpha, or None.
        deep: True if it stores more than 8 bits per channel.
        options: Options of the encoder.
        container: Options of the container.
    """

    name: str
    opaque: str
    alpha: str | None
    deep: bool = False
    options: dict[str, str] = field(default_factory=dict)
    container: dict[str, str] = field(default_factory=dict)


CODECS = {
    ".mp4": Codec("libx264", "yuv420p", None, False, {"crf": "16", "preset": "medium"}, {"movflags": "+faststart"}),
    ".mov": Codec("prores_ks", "yuv444p10le", "yuva444p10le", True, {"profile": "4", "vendor": "apl0"}),
    ".webm": Codec(
        *("libvpx-vp9", "yuv420p", "yuva420p", False),
        {"crf": "18", "b": "0", "cpu-used": "4", "row-mt": "1", "auto-alt-ref": "0"},
    ),
}


def check(suffix: str) -> None:
    """Raise BackendError if PyAV or the encoder of a container is missing."""
    av, codec = _library(), CODECS[suffix]
    try:
        av.codec.Codec(codec.name, "w")
    except (av.error.FFmpegError, ValueError) as error:
        raise errors.BackendError(
            f"{suffix}: the installed PyAV has no encoder {codec.name}; remedy: pip install --force-reinstall av, or "
            "write PNG pictures to a folder"
        ) from error


@contextlib.contextmanager
def writing(path: Path, fps: float, *, alpha: bool = False) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield a function that appends a picture, [H, W, 3 or 4] sRGB in [0, 1], straight alpha, to a video.

    The file gets its name when the block ends without an error; otherwise it is deleted.

    Args:
        path: The video; its suffix is one of `CODECS`.
        fps: Frames per second.
        alpha: True to store alpha.

    Raises:
        BackendError: PyAV or the encoder is missing.
        ConfigError: The file cannot be written. Errors of the block pass unchanged.
    """
    av, codec = _library(), CODECS[path.suffix.lower()]
    check(path.suffix.lower())
    rate = Fraction(fps).limit_denominator(MAX_DENOMINATOR)
    refusals = (av.error.FFmpegError, OSError)
    of_block = None
    try:
        with (
            atomic_files.replacing_by_name(path) as temporary,
            av.open(str(temporary), "w", options=codec.container) as container,
        ):
            stream = container.add_stream(codec.name, rate=rate, options=codec.options)
            stream.pix_fmt = codec.alpha if alpha else codec.opaque
            _tag(stream.codec_context)
            count = 0

            def append(picture: np.ndarray) -> None:
                nonlocal count
                if count == 0:
                    stream.height, stream.width = picture.shape[:2]
                frame = _frame(av, codec, picture, stream.pix_fmt)
                frame.pts, frame.time_base = count, 1 / rate
                try:
                    container.mux(stream.encode(frame))
                except refusals as error:
                    raise _refused(path, error) from error
                count += 1

            try:
                yield append
            except Exception as error:
                of_block = error
                raise
            container.mux(stream.encode(None))
    except refusals as error:
        if error is of_block:
            raise
        raise _refused(path, error) from error


def _refused(path: Path, error: OSError) -> errors.ConfigError:
    reason = error.strerror or error
    return errors.ConfigError(
        f"{path}: the video cannot be written ({reason}); check the folder and the free disk space"
    )


def _frame(av: Any, codec: Codec, picture: np.ndarray, pixel_format: str) -> Any:
    """Return a frame in the encoder's pixel format."""
    kind, most = (np.uint16, 65535) if codec.deep else (np.uint8, 255)
    pixels = np.rint(np.clip(np.nan_to_num(picture), 0, 1) * most).astype(kind)
    source = {(False, 3): "rgb24", (False, 4): "rgba", (True, 3): "rgb48le", (True, 4): "rgba64le"}
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), source[codec.deep, pixels.shape[2]])
    frame = frame.reformat(format=pixel_format, dst_colorspace=BT709, dst_color_range=LIMITED)
    _tag(frame)
    return frame


def _tag(target: Any) -> None:
    """Set the colour tags of a frame or of a codec."""
    target.color_primaries, target.color_trc, target.colorspace, target.color_range = BT709, SRGB, BT709, LIMITED


def _library() -> Any:
    with extras.required("videos", "video"):
        import av
    return av

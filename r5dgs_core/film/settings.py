"""Settings of a film, and the checks that need neither scene nor numpy. Imports only the standard library."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from .. import errors

VIDEOS = (".mp4", ".mov", ".webm")
PICTURES = (".png", ".exr")
PASSES = ("depth", "index", "cryptomatte", "alpha")
SIZES = (16, 8192)  # smallest and largest side of a picture, pixels
MAX_SAMPLES = 8
FPS_RANGE = (1e-3, 1e3)


@dataclass(frozen=True)
class Settings:
    """Settings of a film.

    Attributes:
        out: Video, picture or folder of frames.
        camera: One camera (name or number of a captured one, "orbit", or a JSON file), or several captured ones for a
            curve through them; empty for the first captured one.
        time: First and last scene time, equal for a still scene; None for all times up to the default horizon.
        seconds: Length of the film; None for that of the scene or of the camera path.
        fps: Frames per second; None for those of the camera path, or 24.
        size: Width and height, or 0 and the longer side, pixels; None for the size of the camera.
        samples: Supersampling: pictures are drawn at ``samples`` times the width and height, and averaged.
        mode: Playback mode past t_max.
        transparent: True for a picture with alpha instead of the sky.
        marker: True to mark observed and predicted time.
        passes: Further layers of EXR pictures, some of `PASSES`.
        frames: First and last frame to write to a folder; None for all.
        share: True to leave existing frames and share the others with processes that write to the same folder.
        overwrite: True to replace existing files.
    """

    out: Path
    camera: tuple[str, ...] = ()
    time: tuple[float, float] | None = None
    seconds: float | None = None
    fps: float | None = None
    size: tuple[int, int] | None = None
    samples: int = 1
    mode: str = "rigid"
    transparent: bool = False
    marker: bool = False
    passes: tuple[str, ...] = ()
    frames: tuple[int, int] | None = None
    share: bool = False
    overwrite: bool = False

    @property
    def suffix(self) -> str:
        """Suffix of the files: that of ``out``, or of the frames in a folder."""
        own = self.out.suffix.lower()
        return (".exr" if self.passes else ".png") if self.is_folder else own

    @property
    def is_folder(self) -> bool:
        """True if frames are written to a folder."""
        return self.out.is_dir() or not self.out.suffix

    @property
    def is_video(self) -> bool:
        """True if a video is written."""
        return not self.is_folder and self.out.suffix.lower() in VIDEOS

    @property
    def even(self) -> bool:
        """True if width and height must be even, as colours are stored at half the resolution."""
        return self.is_video and self.suffix != ".mov"


def check(settings: Settings, beside: Path | None = None) -> None:
    """Raise UsageError if settings are out of range or contradict each other.

    Args:
        settings: The settings.
        beside: Data set whose images are shown beside the picture, or None.
    """
    out, kind = settings.out, settings.suffix
    known = (*VIDEOS, *PICTURES)
    if not settings.is_folder and kind not in known:
        raise errors.UsageError(f"--out {out}: expected a folder or a name that ends in one of {', '.join(known)}")
    if (settings.share or settings.frames) and not settings.is_folder:
        option = "--share" if settings.share else "--frames"
        raise errors.UsageError(f"{option}: applies to a folder of frames; give --out a folder")
    if settings.share and settings.overwrite:
        raise errors.UsageError("--share keeps existing frames, --overwrite replaces them; leave one out")
    if settings.passes and kind != ".exr":
        raise errors.UsageError("--passes: needs EXR pictures; give --out a folder or a name that ends in .exr")
    if kind == ".exr" and (settings.marker or beside is not None):
        option = "--marker" if settings.marker else "--beside"
        raise errors.UsageError(f"{option}: applies to videos and PNG pictures, not to EXR layers")
    if settings.transparent and kind == ".mp4":
        raise errors.UsageError("--transparent: .mp4 has no alpha; use .mov (ProRes 4444) or .webm (VP9)")
    if beside is not None and len(settings.camera) > 1:
        raise errors.UsageError("--beside: needs one captured camera; give --camera its name")
    _check_numbers(settings)


def _check_numbers(settings: Settings) -> None:
    if settings.time is not None:
        start, end = settings.time
        if not (math.isfinite(start) and math.isfinite(end) and start <= end):
            raise errors.UsageError(
                f"--time {start:g}:{end:g}: expected finite scene times, the first not after the last"
            )
        single = not settings.is_folder and not settings.is_video
        if single and start != end:
            raise errors.UsageError(f"--time {start:g}:{end:g}: a single picture has one time; give --out a folder")
    if not 1 <= settings.samples <= MAX_SAMPLES:
        raise errors.UsageError(f"--samples {settings.samples}: expected 1 to {MAX_SAMPLES}")
    if settings.fps is not None and not FPS_RANGE[0] <= settings.fps <= FPS_RANGE[1]:
        raise errors.UsageError(f"--fps {settings.fps:g}: expected {FPS_RANGE[0]:g} to {FPS_RANGE[1]:g}")
    if settings.size is not None:
        width, height = settings.size
        given = f"--size {width}x{height}" if width else f"--size {height}"
        sides = [width or height, height]
        if not all(SIZES[0] <= side <= SIZES[1] for side in sides):
            raise errors.UsageError(f"{given}: expected sides of {SIZES[0]} to {SIZES[1]} pixels")
        if settings.even and (width % 2 or height % 2):
            raise errors.UsageError(f"{given}: {settings.suffix} needs even numbers of pixels")

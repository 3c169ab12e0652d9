"""Dataclasses of a preparation: the request, and the plan that determines the data set."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..capture.calibration.calibration import Calibration
from . import image_size, rectify
from .cameras import Camera
from .clock import Offset
from .data_splits import HoldOut, Timeline
from .frame_choice import Choice, Window
from .unknown_cameras import UnknownCameras

IMAGES = "images"


@dataclass(frozen=True)
class Request:
    """Arguments of `prepare`.

    Attributes:
        source: Folder of videos or frames, or one video.
        out: Folder of the data set.
        calibration: File or folder of the calibration; that in the source's folder if None.
        window: Part of the recording.
        hold_out: Frames that training does not use.
        lines: Height of the images; the largest that fits the memory if None.
        lossless: Write PNG instead of JPEG.
        sync: One of `clocks.METHODS`.
        offsets: Known offsets of clocks by camera, seconds.
        rate: Frames per second of recordings without usable times.
        overwrite: Replace a data set that was prepared with other settings.
        unknown: Known facts about cameras without a calibration.
        up: Up of the world (`gauge.upright`), or None for that of the calibration.
        meters_per_unit: Length of a unit of the world, or None for that of the calibration.
        masks: Folder of masks of the frames, whose objects are compared to measure clocks.
    """

    source: Path
    out: Path
    calibration: Path | None = None
    window: Window = field(default_factory=Window)
    hold_out: HoldOut = field(default_factory=HoldOut)
    lines: int | None = None
    lossless: bool = False
    sync: str = "auto"
    offsets: dict[str, float] = field(default_factory=dict)
    rate: float | None = None
    overwrite: bool = False
    unknown: UnknownCameras = field(default_factory=UnknownCameras)
    up: str | None = None
    meters_per_unit: float | None = None
    masks: Path | None = None


@dataclass(frozen=True)
class Plan:
    """Everything that determines the data set.

    Attributes:
        request: The request.
        cameras: The cameras.
        calibration: Their calibration.
        offsets: Offsets of their clocks.
        choice: Chosen frames.
        timeline: Scene times and splits.
        size: Height of the images.
        notes: Remarks for the user.
        lost: Indices of frames that cannot be decoded, by camera; empty before the images are written.
    """

    request: Request
    cameras: tuple[Camera, ...]
    calibration: Calibration
    offsets: tuple[Offset, ...]
    choice: Choice
    timeline: Timeline
    size: image_size.Size
    notes: tuple[str, ...]
    lost: dict[str, list[int]] = field(default_factory=dict)

    def image_name(self, camera: int, index: int) -> str:
        """Return the path of an image in the data set, without suffix."""
        return f"{IMAGES}/{self.cameras[camera].name}/{self.cameras[camera].source.frame_name(index)}"

    def rectifier(self, camera: int, index: int) -> rectify.Rectifier:
        """Return the rectifier of a camera's frame."""
        one = self.cameras[camera]
        return rectify.rectifier(one.lens(index), (one.source.width, one.source.height), self.size.lines)

    @property
    def suffix(self) -> str:
        """Suffix of the images."""
        return ".png" if self.request.lossless else ".jpg"

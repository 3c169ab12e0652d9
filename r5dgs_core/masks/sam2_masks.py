"""Masks by SAM2: all objects that are visible in the key frames of a video, tracked through the video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from ..data import mask_notes
from . import sam2_segments, sam2_tracking
from .sam2_model import Sam2
from .videos import Video


@dataclasses.dataclass(frozen=True)
class TrackSettings:
    """Settings for tracking a video with SAM2.

    Attributes:
        key_frames: Number of images in which all objects are segmented.
        overlap: Minimum IoU at which a segment of a key frame counts as an already tracked object.
        objects: Maximum number of objects per video.
        together: Number of objects tracked at once, which bounds the memory.
        gap: Longest gap in an object's track, in images, whose likely pixels are marked unknown instead of background.
    """

    key_frames: int = 3
    overlap: float = 0.5
    objects: int = 255
    together: int = 32
    gap: int = 8


class Sam2Masks:
    """Mask backend that uses SAM2.

    Args:
        model: The model.
        segment: Settings for segmenting key frames.
        track: Settings for tracking.
    """

    name, numbering = "sam2", mask_notes.VIDEO
    own_names: Path | None = None

    def __init__(
        self,
        model: Sam2,
        segment: sam2_segments.SegmentSettings | None = None,
        track: TrackSettings | None = None,
    ):
        self.model = model
        self.segment = segment or sam2_segments.SegmentSettings()
        self.track = track or TrackSettings()
        self.made_with = {
            "model": model.name,
            "weights": model.digest,
            **dataclasses.asdict(self.segment),
            **dataclasses.asdict(self.track),
        }

    def label(self, video: Video, room: Path, report: Callable[[float], None]) -> Iterator[np.ndarray | None]:
        """Implement `make_masks.MaskBackend.label`."""
        camera = video.views[0].camera
        canvas = sam2_tracking.Canvas(len(video.views), camera.height, camera.width, room)
        try:
            self._paint(video, canvas, report)
            canvas.mark_gaps(self.track.gap)
            for index in range(len(video.views)):
                yield canvas.ids[index].astype(np.int32)
        finally:
            canvas.close()

    def _paint(self, video: Video, canvas: sam2_tracking.Canvas, report: Callable[[float], None]) -> None:
        frames = sam2_tracking.Frames(self.model, video)
        keys = key_frames(len(frames), self.track.key_frames)
        known: dict[int, list[np.ndarray]] = {key: [] for key in keys}
        together, count = self.track.together, 0
        for turn, key in enumerate(keys):
            found = sam2_segments.find(self.model, video.image(key), self.segment)
            found = sam2_segments.new_ones(found, known.pop(key), self.track.overlap)[: self.track.objects - count]
            groups = [found[first : first + together] for first in range(0, len(found), together)]
            for n, group in enumerate(groups):
                ids = range(count + 1, count + 1 + len(group))
                count += len(group)
                marked = torch.stack([segment.logits for segment in group]).to(self.model.device)
                for k, (index, logits) in enumerate(sam2_tracking.follow(self.model, frames, key, marked)):
                    canvas.paint(index, ids, sam2_segments.full_size(logits, canvas.ids.shape[1:]).cpu().numpy())
                    if index in known:
                        known[index] += list(logits.gt(0).cpu().numpy())
                    report((turn + (n + (k + 1) / len(frames)) / len(groups)) / len(keys))
            report((turn + 1) / len(keys))


def key_frames(count: int, wanted: int) -> list[int]:
    """Indices of the key frames of a video: the middle image, or an even spread that includes both ends."""
    if wanted == 1:
        return [count // 2]
    return sorted({int(k) for k in np.linspace(0, count - 1, min(wanted, count)).round()})

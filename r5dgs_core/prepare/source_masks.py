"""Masks of the recordings' frames, as masks of the images: undistorted and reduced like them.

FOLDER/cam0/000012.png     frame 12 of cam0; or the name of the frame's file
FOLDER/objects.json        names of the ids, optional
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, errors
from ..data import dataset as datasets
from ..data import mask_notes, masks, view_masks
from ..data.annotations import OBJECTS, read_objects
from ..data.splits import SPLITS
from ..masks import make_masks
from ..masks.make_masks import MaskingResult, Progress
from ..masks.videos import Video
from . import frame_masks
from .plan import Plan


class SourceMasks:
    """Mask backend (`masks.make_masks.MaskBackend`) that reads masks of the recordings' frames.

    Args:
        folder: The folder; its ``masks.json`` is applied.
        plan: The prepared data set.

    Raises:
        DatasetError: The folder has no masks of the cameras, or they cannot be decoded.
    """

    name = "frames"
    own_names: Path | Mapping[int, str] | None = None

    def __init__(self, folder: Path, plan: Plan):
        self.folder, self._plan = Path(folder), plan
        files = frame_masks.find(self.folder, [camera.source for camera in plan.cameras])
        notes = mask_notes.read(self.folder)
        self.numbering, self._unknown = notes.numbering, notes.unknown
        self.made_with: dict[str, Any] = {"folder": self.folder.name, "unknown": notes.unknown}
        self._found = {
            plan.image_name(number, index): (present[index], number, index)
            for number, present in enumerate(files)
            for index in plan.choice.indices[number].tolist()
            if index in present
        }
        if not self._found:
            example = plan.cameras[0].source.frame_name(int(plan.choice.indices[0][0]))
            name = plan.cameras[0].name
            raise errors.DatasetError(f"{folder}: expected masks such as {name}/{example}.png, found none")
        self._colors = masks.color_table([path for path, *_ in self._found.values()])

    def label(self, video: Video, room: Path, report: Callable[[float], None]) -> Iterator[np.ndarray | None]:
        """Implement `make_masks.MaskBackend.label`."""
        for k, view in enumerate(video.views):
            if view.name in self._found:
                path, number, index = self._found[view.name]
                ids = masks.read(path, self._colors, self._unknown)
                yield self._plan.rectifier(number, index).mask(ids, str(path))
            else:
                yield None
            report((k + 1) / len(video.views))


def write(folder: Path, plan: Plan, progress: Progress) -> MaskingResult:
    """Write the masks of all images, and the names of their ids.

    Args:
        folder: Masks of the recordings' frames.
        plan: The prepared data set.
        progress: Called with progress events.

    Raises:
        DatasetError: The masks cannot be read.
    """
    backend = SourceMasks(folder, plan)
    out = Path(plan.request.out)
    dataset = datasets.read(out, view_masks.NO_MASKS)
    views = [view for split in SPLITS for view in dataset.views(split)]
    made = make_masks.make(views, backend, out / view_masks.MASKS, overwrite=plan.request.overwrite, progress=progress)
    if (folder / OBJECTS).is_file():
        read_objects(folder)
        atomic_files.write(out / OBJECTS, (folder / OBJECTS).read_bytes())
    return made

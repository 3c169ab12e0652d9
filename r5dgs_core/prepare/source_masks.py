"""Masks of the recordings' frames, as masks of the images: undistorted and reduced like them.

FOLDER/cam0/000012.png     frame 12 of cam0; or the name of the frame's file
FOLDER/objects.json        names of the ids, optional
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from . import names
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
        if not self.folder.is_dir():
            raise errors.DatasetError(f"--masks {folder}: expected a folder of masks, found none")
        notes = mask_notes.read(self.folder)
        self.numbering, self._unknown = notes.numbering, notes.unknown
        self.made_with: dict[str, Any] = {"folder": self.folder.name, "unknown": notes.unknown}
        cameras = [camera.name for camera in plan.cameras]
        folders = {path.name: path for path in sorted(self.folder.iterdir()) if path.is_dir()}
        matched = names.match(cameras, list(folders))
        if matched is None:
            raise errors.DatasetError(
                f"{folder}: expected a folder of masks per camera ({', '.join(cameras)}), found "
                f"{', '.join(folders) or 'none'}"
            )
        files = [_masks_of(folders[matched[name]]) for name in cameras]
        first = _first_number(self.folder, plan, files)
        self._found = {
            plan.image_name(number, index): (path, number, index)
            for number, present in enumerate(files)
            for index, path in _by_index(plan, number, present, first).items()
        }
        if not self._found:
            example = plan.cameras[0].source.frame_name(int(plan.choice.indices[0][0]))
            raise errors.DatasetError(f"{folder}: expected masks such as {cameras[0]}/{example}.png, found none")
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


def _masks_of(folder: Path) -> dict[str, Path]:
    """Return the masks of a camera by their names without the suffix."""
    return {path.stem: path for path in folder.iterdir() if path.suffix.lower() == ".png"}


def _numbered(present: Mapping[str, Path]) -> dict[int, Path]:
    """Return masks by the last number in their names."""
    return {int(found[-1]): path for stem, path in present.items() if (found := re.findall(r"\d+", stem))}


def _first_number(folder: Path, plan: Plan, files: Sequence[Mapping[str, Path]]) -> int:
    """Return the number of a recording's first frame in the names of masks, 0 or 1.

    Raises:
        DatasetError: Some frames lack masks, so the names permit both.
    """
    sources = [camera.source for camera in plan.cameras]
    numbers = [_numbered(present).keys() for present in files]
    if any(0 in found for found in numbers):
        return 0
    if any(len(source.times) in found for source, found in zip(sources, numbers, strict=True)):
        return 1
    for source, present in zip(sources, files, strict=True):
        names = {source.frame_name(index) for index in range(len(source.times))}
        if other := next((name for name in present if name not in names), None):
            raise errors.DatasetError(
                f"{folder}: masks such as {other}.png may be numbered from 0 or from 1, because the first and the last "
                f"one are missing; name them like the frames, such as {source.frame_name(0)}.png for the first one"
            )
    return 0


def _by_index(plan: Plan, number: int, present: Mapping[str, Path], first: int) -> dict[int, Path]:
    """Return the mask of each chosen frame of a camera, by the frame's name or else by the number in the mask's name.

    Args:
        plan: The prepared data set.
        number: Number of the camera.
        present: Result of `_masks_of`.
        first: Result of `_first_number`.
    """
    source, chosen = plan.cameras[number].source, plan.choice.indices[number].tolist()
    named = {index: present[source.frame_name(index)] for index in chosen if source.frame_name(index) in present}
    if named and not (source.videos and first):
        return named
    numbered = _numbered(present)
    return {index: numbered[index + first] for index in chosen if index + first in numbered}


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

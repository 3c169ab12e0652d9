"""Mask backends that read existing masks: a folder (`PrecomputedMasks`), or a capture of Blender (`CapturedMasks`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors
from ..data import dataset as datasets
from ..data import mask_notes, masks
from ..data.annotations import OBJECTS, read_objects
from .videos import Video


class PrecomputedMasks:
    """Existing masks in a folder: ids of 8 or 16 bits, palettes, or one flat colour per object.

    A mask has the path of its image, or the image's file name in the folder itself.

    Args:
        folder: The folder; its ``masks.json`` is applied.
        views: All requested views.
        unknown: Value of unknown pixels; None for that of ``masks.json``.

    Raises:
        DatasetError: The folder has no mask of the views, or the masks cannot be decoded.
        ConfigError: ``unknown`` is not a valid value for these masks.
    """

    name = "precomputed"

    def __init__(self, folder: Path, views: tuple[datasets.View, ...], unknown: int | None = None):
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise errors.DatasetError(f"{folder}: expected a folder of masks, found none")
        notes = mask_notes.read(self.folder)
        self.numbering = notes.numbering
        self.unknown = notes.unknown if unknown is None else unknown
        if self.unknown not in mask_notes.UNKNOWN_VALUES:
            raise errors.ConfigError(f"--unknown {unknown}: expected 255 or {masks.UNKNOWN}")
        names = [view.name.rsplit("/", 1)[-1] for view in views]
        flat = len(set(names)) == len(names)
        self._paths = {}
        for view, name in zip(views, names, strict=True):
            places = [self.folder / f"{view.name}.png", *([self.folder / f"{name}.png"] if flat else [])]
            self._paths[view.name] = next((path for path in places if path.is_file()), None)
        found = [path for path in self._paths.values() if path is not None]
        if not found:
            raise errors.DatasetError(
                f"{folder}: expected masks such as {views[0].name}.png, found none; masks are PNG files with the "
                "names of their images"
            )
        self._colors = masks.color_table(found)
        if self._colors and unknown is not None:
            raise errors.ConfigError(
                f"--unknown {unknown}: the masks in {folder} are coded by colour and have no such value; leave it out"
            )
        own_names = self.folder / OBJECTS
        self.own_names = own_names if own_names.is_file() else None
        self.made_with: dict[str, Any] = {"folder": str(self.folder.resolve()), "unknown": self.unknown}

    def label(self, video: Video, room: Path, report: Callable[[float], None]) -> Iterator[np.ndarray | None]:
        """Implement `make_masks.MaskBackend.label`."""
        for k, view in enumerate(video.views):
            path = self._paths[view.name]
            if path is None:
                yield None
            else:
                ids = masks.read(path, self._colors, self.unknown)
                yield masks.resize(ids, view.camera.width, view.camera.height, str(path))
            report((k + 1) / len(video.views))


class CapturedMasks(PrecomputedMasks):
    """Object index masks rendered by the extension's capture: exact, complete, with a name for every id.

    Args:
        root: Folder of the captured data set.
        views: All requested views.

    Raises:
        DatasetError: The folder is not a captured data set.
    """

    name = "blender"

    def __init__(self, root: Path, views: tuple[datasets.View, ...]):
        super().__init__(Path(root) / datasets.MASKS, views)
        lacking = [name for name, path in self._paths.items() if path is None]
        if lacking or self._colors:
            what = f"{lacking[0]} has no mask" if lacking else "its masks are coded by colour"
            raise errors.DatasetError(
                f"{root}: expected a data set of the capture, but {what}. Remedy: use --backend precomputed for "
                "such masks"
            )
        self._names = read_objects(Path(root))[0]

    def label(self, video: Video, room: Path, report: Callable[[float], None]) -> Iterator[np.ndarray | None]:
        """Implement `make_masks.MaskBackend.label`."""
        for view, ids in zip(video.views, super().label(video, room, report), strict=True):
            assert ids is not None
            foreign = set(np.unique(ids).tolist()) - set(self._names) - {0, masks.UNKNOWN}
            if foreign:
                raise errors.DatasetError(
                    f"{self._paths[view.name]}: id {min(foreign)} has no name in objects.json, as those of a capture "
                    "have. Remedy: use --backend precomputed for such masks"
                )
            yield ids

"""Masks of the recordings' frames: which file belongs to which frame of which camera.

FOLDER/cam0/000012.png     frame 12 of cam0; or the name of the frame's file
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from .. import errors
from . import names
from .camera_source import CameraSource


def find(folder: Path, sources: Sequence[CameraSource]) -> tuple[dict[int, Path], ...]:
    """Return the masks of each camera by the index of the frame.

    Args:
        folder: Folder of the masks.
        sources: The cameras.

    Raises:
        DatasetError: The folder has no masks of the cameras, or their numbers are ambiguous.
    """
    if not folder.is_dir():
        raise errors.DatasetError(f"--masks {folder}: expected a folder of masks, found none")
    cameras = [source.name for source in sources]
    folders = {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()}
    matched = names.match(cameras, list(folders))
    if matched is None:
        raise errors.DatasetError(
            f"{folder}: expected a folder of masks per camera ({', '.join(cameras)}), found "
            f"{', '.join(folders) or 'none'}"
        )
    files = [_masks_of(folders[matched[name]]) for name in cameras]
    first = _first_number(folder, sources, files)
    return tuple(_by_index(source, present, first) for source, present in zip(sources, files, strict=True))


def _masks_of(folder: Path) -> dict[str, Path]:
    """Return the masks of a camera by their names without the suffix."""
    return {path.stem: path for path in folder.iterdir() if path.suffix.lower() == ".png"}


def _numbered(present: Mapping[str, Path]) -> dict[int, Path]:
    """Return masks by the last number in their names."""
    return {int(found[-1]): path for stem, path in present.items() if (found := re.findall(r"\d+", stem))}


def _first_number(folder: Path, sources: Sequence[CameraSource], files: Sequence[Mapping[str, Path]]) -> int:
    """Return the number of a recording's first frame in the names of masks, 0 or 1.

    Raises:
        DatasetError: Some frames lack masks, so the names permit both.
    """
    numbers = [_numbered(present).keys() for present in files]
    if any(0 in found for found in numbers):
        return 0
    if any(len(source.times) in found for source, found in zip(sources, numbers, strict=True)):
        return 1
    for source, present in zip(sources, files, strict=True):
        expected = {source.frame_name(index) for index in range(len(source.times))}
        if other := next((name for name in present if name not in expected), None):
            raise errors.DatasetError(
                f"{folder}: masks such as {other}.png may be numbered from 0 or from 1, because the first and the last "
                f"one are missing; name them like the frames, such as {source.frame_name(0)}.png for the first one"
            )
    return 0


def _by_index(source: CameraSource, present: Mapping[str, Path], first: int) -> dict[int, Path]:
    """Return the mask of each frame of a camera, by the frame's name or else by the number in the mask's name.

    Args:
        source: The camera.
        present: Result of `_masks_of`.
        first: Result of `_first_number`.
    """
    every = range(len(source.times))
    named = {index: present[source.frame_name(index)] for index in every if source.frame_name(index) in present}
    if named and not (source.videos and first):
        return named
    numbered = _numbered(present)
    return {index: numbered[index + first] for index in every if index + first in numbered}

"""Description of a mask folder, the optional ``masks.json`` beside the masks.

    {"format_version": 1, "backend": "sam2", "numbering": "video", "unknown": 65535, "finished": true,
     "videos": {"cam0": {"images": ["train/r_0000", ...], "ids": [1, 2, 5]}, ...}, "made_with": {...}}

Without the file, ids are valid in the whole scene and 65535 is unknown.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import atomic_files, errors, strict_json
from . import masks

FILE = "masks.json"
FORMAT_VERSION = 1
SCENE, VIDEO = "scene", "video"
UNKNOWN_VALUES = (255, masks.UNKNOWN)


@dataclass(frozen=True)
class Video:
    """Masks of one video, which share a numbering.

    Attributes:
        images: Names of its views, in temporal order.
        ids: Ids that occur in it, without 0 and unknown.
    """

    images: tuple[str, ...]
    ids: tuple[int, ...]


@dataclass(frozen=True)
class MaskNotes:
    """Content of ``masks.json``.

    Attributes:
        backend: Tool that made the masks, "" if unknown.
        numbering: "scene" if an id is one object in all masks, "video" if it is one within a video.
        unknown: Value of unknown pixels in the files: 65535, or 255 in masks of 8 bits.
        finished: True if all requested masks exist.
        videos: The videos by name.
        made_with: Settings of the backend; a run with other settings does not resume.
    """

    backend: str = ""
    numbering: str = SCENE
    unknown: int = masks.UNKNOWN
    finished: bool = True
    videos: Mapping[str, Video] = dataclasses.field(default_factory=dict)
    made_with: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def video_of(self) -> dict[str, str]:
        """Video of each view, if ids are valid per video; otherwise empty."""
        if self.numbering == SCENE:
            return {}
        return {image: name for name, video in self.videos.items() for image in video.images}


def read(folder: Path) -> MaskNotes:
    """Read ``masks.json`` of a mask folder; returns the defaults if it is missing.

    Raises:
        DatasetError: The file is damaged or of another version.
    """
    path = Path(folder) / FILE
    if not path.exists():
        return MaskNotes()
    content = strict_json.read(path, errors.DatasetError)
    version = content.get("format_version") if isinstance(content, dict) else None
    if version != FORMAT_VERSION:
        raise errors.DatasetError(f"{path}: expected 'format_version' {FORMAT_VERSION}, found {version!r}")
    try:
        videos = {
            str(name): Video(tuple(map(str, video["images"])), tuple(map(int, video["ids"])))
            for name, video in content.get("videos", {}).items()
        }
        notes = MaskNotes(
            backend=str(content.get("backend", "")),
            numbering=content.get("numbering", SCENE),
            unknown=content.get("unknown", masks.UNKNOWN),
            finished=bool(content.get("finished", True)),
            videos=videos,
            made_with=dict(content.get("made_with", {})),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise errors.DatasetError(
            f"{path}: expected 'videos' of 'images' and 'ids', and 'made_with' as an object "
            f"({type(error).__name__}: {error})"
        ) from error
    if notes.numbering not in (SCENE, VIDEO):
        raise errors.DatasetError(f"{path}: 'numbering' must be {SCENE!r} or {VIDEO!r}, found {notes.numbering!r}")
    if notes.unknown not in UNKNOWN_VALUES:
        values = " or ".join(map(str, UNKNOWN_VALUES))
        raise errors.DatasetError(f"{path}: 'unknown' must be {values}, found {notes.unknown!r}")
    return notes


def write(notes: MaskNotes, folder: Path) -> Path:
    """Write ``masks.json`` into a mask folder atomically; returns its path.

    Raises:
        DatasetError: The file cannot be written.
    """
    path = Path(folder) / FILE
    content = {"format_version": FORMAT_VERSION, **dataclasses.asdict(notes)}
    try:
        atomic_files.write(path, (json.dumps(content, indent=1) + "\n").encode())
    except OSError as error:
        raise errors.DatasetError(f"{path}: cannot be written: {error}") from error
    return path

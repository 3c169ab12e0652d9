"""Creation of a data set's masks, video by video and resumable."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .. import atomic_files, errors
from ..data import dataset as datasets
from ..data import mask_notes, masks
from ..data.annotations import OBJECTS
from . import videos

Progress = Callable[[dict[str, Any]], None]
Report = Callable[[float], None]  # called with the finished share of a video


class MaskBackend(Protocol):
    """Source of masks.

    Attributes:
        name: Name of the backend.
        numbering: Scope of its ids, `mask_notes.SCENE` or `mask_notes.VIDEO`.
        made_with: Inputs and settings that the masks depend on; JSON types.
        own_names: Names of ids that differ from the data set's, as an ``objects.json`` or by id, or None.
    """

    name: str
    numbering: str
    made_with: dict[str, Any]
    own_names: Path | Mapping[int, str] | None

    def label(self, video: videos.Video, room: Path, report: Report) -> Iterator[np.ndarray | None]:
        """Yield the object ids of each image of a video, in order; None for images without a mask.

        Args:
            video: The video.
            room: Folder for temporary files that are too large for memory.
            report: Called with the finished share of the video.
        """
        ...


@dataclasses.dataclass(frozen=True)
class MaskingResult:
    """Result of `make`.

    Attributes:
        folder: The folder of masks.
        images: Number of masks in it.
        videos: Number of videos with masks.
        kept: Number of these videos that were finished before.
        objects: Number of ids, counted per numbering.
        unknown: Share of unknown pixels among those written now.
        numbering: Scope of the ids, `mask_notes.SCENE` or `mask_notes.VIDEO`.
    """

    folder: Path
    images: int
    videos: int
    kept: int
    objects: int
    unknown: float
    numbering: str


def make(
    views: Sequence[datasets.View],
    backend: MaskBackend,
    folder: Path,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> MaskingResult:
    """Write a mask for each view, ``FOLDER/<view name>.png``, and their description (`mask_notes`).

    Finished videos are skipped. An interrupted run loses only the current video.

    Args:
        backend: Source of the masks.
        folder: Folder of masks; created if missing.
        overwrite: True to replace other masks in the folder.
        progress: Called with progress events.

    Returns:
        Summary of the folder.

    Raises:
        DatasetError: The folder holds masks that would be lost, or cannot be written.
        BackendError: The backend fails.
    """
    folder = Path(folder)
    notes, is_new = _begin(views, backend, folder, overwrite)
    every = videos.of(views)
    todo = [video for video in every if not _is_done(video, notes, folder)]
    notes = dataclasses.replace(
        notes, videos={video.name: notes.videos[video.name] for video in every if video not in todo}
    )
    count = _Count()

    def keep(view: datasets.View, ids: np.ndarray | None) -> None:
        nonlocal is_new
        if is_new:  # not before the first mask: a backend that finds nothing leaves the folder as it was
            mask_notes.write(notes, folder)
            _remove(folder / OBJECTS)  # names of the replaced ids
            is_new = False
        path = folder / f"{view.name}.png"
        if ids is None:
            _remove(path)  # a mask of an earlier set would be read with these
        else:
            masks.write(path, ids)

    for video, found in _labelled(todo, backend, folder, count, keep, progress):
        notes = dataclasses.replace(notes, videos={**notes.videos, video.name: found})
        mask_notes.write(notes, folder)
    if backend.own_names is not None or (notes.numbering == mask_notes.VIDEO and len(every) == 1):
        _write_names(notes, backend.own_names, folder)
    notes = dataclasses.replace(notes, finished=True)
    mask_notes.write(notes, folder)
    return _made(notes, folder, len(every) - len(todo), count)


def check(
    views: Sequence[datasets.View], backend: MaskBackend, folder: Path, *, progress: Progress | None = None
) -> MaskingResult:
    """Read all existing masks of a folder without writing; see `make`."""
    count, every = _Count(), videos.of(views)
    found = {
        video.name: masks_of
        for video, masks_of in _labelled(every, backend, folder, count, lambda view, ids: None, progress)
    }
    return _made(mask_notes.MaskNotes(backend.name, backend.numbering, videos=found), folder, 0, count)


@dataclasses.dataclass
class _Count:
    """Number of mask pixels, and of unknown ones."""

    pixels: int = 0
    unknown: int = 0


def _labelled(
    todo: Sequence[videos.Video],
    backend: MaskBackend,
    room: Path,
    count: _Count,
    keep: Callable[[datasets.View, np.ndarray | None], None],
    progress: Progress | None,
) -> Iterator[tuple[videos.Video, mask_notes.Video]]:
    """Label videos one after the other; yield each finished video with its images and ids."""
    total, done, began = sum(len(video.views) for video in todo), 0, time.monotonic()
    for video in todo:

        def report(share: float, video: videos.Video = video, before: int = done) -> None:
            now = before + share * len(video.views)
            event = {"event": "masks", "done": int(now), "total": total, "text": video.name}
            if now > 0:
                event["seconds_left"] = (time.monotonic() - began) * (total - now) / now
            if progress is not None:
                progress(event)

        report(0.0)
        seen: set[int] = set()
        images = []
        for view, ids in zip(video.views, backend.label(video, room, report), strict=True):
            keep(view, ids)
            if ids is None:
                continue
            images.append(view.name)
            seen.update(np.unique(ids).tolist())
            count.pixels += ids.size
            count.unknown += int((ids == masks.UNKNOWN).sum())
        done += len(video.views)
        yield video, mask_notes.Video(tuple(images), tuple(sorted(seen - {0, masks.UNKNOWN})))


def _made(notes: mask_notes.MaskNotes, folder: Path, kept: int, count: _Count) -> MaskingResult:
    ids = [video.ids for video in notes.videos.values()]
    return MaskingResult(
        folder=folder,
        images=sum(len(video.images) for video in notes.videos.values()),
        videos=len(notes.videos),
        kept=kept,
        objects=len(set().union(*ids)) if notes.numbering == mask_notes.SCENE else sum(map(len, ids)),
        unknown=count.unknown / max(count.pixels, 1),
        numbering=notes.numbering,
    )


def _write_names(notes: mask_notes.MaskNotes, own_names: Path | Mapping[int, str] | None, folder: Path) -> None:
    """Write ``objects.json``, so that names of the data set's ids are not applied to the folder's own ids."""
    path = folder / OBJECTS
    ids = sorted({object_id for video in notes.videos.values() for object_id in video.ids})
    names = own_names if isinstance(own_names, Mapping) else {}
    made = json.dumps({str(object_id): names.get(object_id, f"object {object_id}") for object_id in ids}, indent=1)
    try:
        atomic_files.write(path, own_names.read_bytes() if isinstance(own_names, Path) else f"{made}\n".encode())
    except OSError as error:
        raise errors.DatasetError(f"{path}: cannot be written: {error}") from error


def _begin(
    views: Sequence[datasets.View], backend: MaskBackend, folder: Path, overwrite: bool
) -> tuple[mask_notes.MaskNotes, bool]:
    """Return the notes to continue, those of the folder if they match the backend, and True if they are new."""
    fresh = mask_notes.MaskNotes(
        backend=backend.name, numbering=backend.numbering, finished=False, made_with=backend.made_with
    )
    present = (folder / mask_notes.FILE).exists()
    if present and not overwrite:
        notes = mask_notes.read(folder)
        known, wanted = ({**one.made_with, "numbering": one.numbering} for one in (notes, fresh))
        if notes.backend == fresh.backend and known == wanted:
            return dataclasses.replace(notes, finished=False), False
        changed = [key for key in {**wanted, **known} if known.get(key) != wanted.get(key)]
        other = repr(notes.backend) if notes.backend else "an unknown backend"
        if notes.backend == backend.name:
            other = f"other settings ({', '.join(changed)})"
        raise errors.DatasetError(
            f"{folder}: its masks were made with {other}; name another folder with --out, or give --overwrite"
        )
    lost = [view.name for view in views if (folder / f"{view.name}.png").exists()]
    if lost and not overwrite:
        raise errors.DatasetError(
            f"{folder}: holds {len(lost)} masks of unknown origin, such as {lost[0]}.png; name "
            "another folder with --out, or give --overwrite"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise errors.DatasetError(f"{folder}: cannot be created: {error}") from error
    return fresh, True


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise errors.DatasetError(f"{path}: cannot be removed: {error}") from error


def _is_done(video: videos.Video, notes: mask_notes.MaskNotes, folder: Path) -> bool:
    """Return True if the folder holds masks of exactly the current images of a video."""
    known = notes.videos.get(video.name)
    if known is None or set(known.images) != {view.name for view in video.views}:
        return False
    return all((folder / f"{name}.png").is_file() for name in known.images)

"""Masks of a data set's views: their folder, their colours and their notes."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from .. import errors, findings
from . import mask_notes, masks
from .splits import SPLITS
from .views import View

MASKS, NO_MASKS = "object_mask", "none"
_log = logging.getLogger(__name__)


def folder_of(root: Path, name: str) -> Path | None:
    """Return the folder of a split's masks, or None if masks are ignored.

    The data set's own folder is always returned under the same path, because its colour-coded masks are numbered
    together with those of the other splits.
    """
    if name == NO_MASKS:
        return None
    folder = root / name  # an absolute path replaces the root
    if folder.resolve() == (root / MASKS).resolve():
        return root / MASKS
    if name != MASKS and not folder.is_dir():
        raise errors.DatasetError(
            f"{folder}: no such folder of masks; give another with --masks, or 'none'", code="D17"
        )
    return folder


def attach(
    views: dict[str, tuple[View, ...]], folders: dict[str, Path | None], hasher: Any, guard: findings.Guard
) -> dict[str, tuple[View, ...]]:
    """Return the views of each split with the colour table and the notes of their mask folders.

    Args:
        views: Views of each split, with the paths of their masks.
        folders: Mask folder of each split.
        hasher: Updated with the notes.
        guard: Entered around each folder.

    Raises:
        DatasetError: A folder other than the data set's own has no mask of a training view, or masks are damaged.
    """
    named = folders["train"] if folders["train"] != folders["val"] else None
    if named is not None and all(view.mask_path is None for view in views["train"]):
        raise errors.DatasetError(
            f"{named}: expected masks such as {views['train'][0].name}.png, found none. Remedy: import masks of "
            "another layout with 'r5dgs masks --from', or train without masks: --masks none",
            code="D17",
        )
    for folder in dict.fromkeys(folders.values()):
        alike = {split: views[split] for split in SPLITS if folders[split] == folder}
        with guard(), findings.coded("D17"):
            alike = _with_colors(alike)
        with guard(), findings.coded("D22"):
            alike = _with_notes(alike, folder, hasher)
        views = views | alike
    return views


def _with_colors(views: dict[str, tuple[View, ...]]) -> dict[str, tuple[View, ...]]:
    """Number the colours of all masks of the splits together, if masks are coded by colour."""
    paths = [view.mask_path for some in views.values() for view in some if view.mask_path is not None]
    colors = masks.color_table(paths)
    if not colors:
        return views
    _log.info("masks are coded by colour: %d colours numbered by value, black is 0", len(colors) - 1)
    return {split: tuple(replace(view, mask_colors=colors) for view in some) for split, some in views.items()}


def _with_notes(views: dict[str, tuple[View, ...]], folder: Path | None, hasher: Any) -> dict[str, tuple[View, ...]]:
    """Apply the mask folder's ``masks.json`` to the views (`mask_notes`)."""
    if folder is None or not (folder / mask_notes.FILE).exists():
        return views
    notes = mask_notes.read(folder)
    if not notes.finished:
        _log.warning("%s: masks are missing; run the command that makes them again", folder)
    videos = notes.video_of()
    lone = "" if notes.numbering == mask_notes.SCENE else "other masks"

    def with_notes(view: View) -> View:
        if view.mask_path is None:
            return view
        return replace(view, mask_unknown=notes.unknown, mask_video=videos.get(view.name, lone))

    hasher.update(f"{notes.numbering} {notes.unknown}".encode() * len(views))  # once per split
    return {split: tuple(map(with_notes, some)) for split, some in views.items()}

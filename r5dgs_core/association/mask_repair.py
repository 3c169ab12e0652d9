"""Repair of a data set's masks: consistent object ids by associating the segments with a trained scene."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from .. import atomic_files, errors
from ..data import dataset as datasets
from ..data import mask_notes, masks
from ..data.annotations import OBJECTS
from ..scene import sampling
from ..scene.scene import Scene
from . import associate, mending, render_segments, render_votes

NEIGHBOURS = 8
TIMES = 16  # maximum number of times at which positions of the Gaussians are compared
BACKEND = "associate"  # name in masks.json
SEGMENTS, SUMMARY = "segments.csv", "association.json"


@dataclass(frozen=True)
class Repair:
    """Repaired masks and their inputs.

    Attributes:
        views: Views with masks, in the order of the association's images.
        incoming: Original masks. Tuple of [H, W]
        result: New ids of segments.
        mended: New masks; objects without a segment of their own may have gained pixels. Tuple of [H, W] uint16
        own_ids: True if the new ids belong to the folder, because those of the data set were valid per video only.
    """

    views: tuple[datasets.View, ...]
    incoming: tuple[np.ndarray, ...]
    result: associate.Association
    mended: tuple[np.ndarray, ...]
    own_ids: bool

    @property
    def numbering(self) -> str:
        """Scope of the new ids, as in `mask_notes`; if all incoming ids are kept, they remain valid per video."""
        apart = self.result.fallback and len({view.mask_video for view in self.views}) > 1
        return mask_notes.VIDEO if apart else mask_notes.SCENE

    @property
    def filled(self) -> int:
        """Number of images in which pixels changed beyond the relabelling of segments."""
        count = 0
        for old, new, own in zip(self.incoming, self.mended, self.result.ids, strict=True):
            ids = np.unique(old[old != masks.UNKNOWN])
            count += bool((mending.relabel(old, ids, own) != new).any())
        return count


def repair(
    scene: Scene,
    dataset: datasets.Dataset,
    *,
    backend: str = "auto",
    progress: Callable[[dict[str, Any]], None] | None = None,
) -> Repair:
    """Associate the segments of the training views' masks.

    Args:
        scene: A scene trained from the data set; preferably trained with --masks none.
        dataset: The data set, with the masks.
        progress: Called with events.

    Raises:
        DatasetError: No training view has a mask, a mask cannot be read, or no mask shows an object.
    """
    progress = progress or (lambda event: None)
    views = tuple(view for view in dataset.train if view.mask_path is not None)
    if not views:
        raise errors.DatasetError(
            f"{dataset.root}: expected masks of training views, found none. Remedy: r5dgs masks, or name their folder "
            "with --masks"
        )
    incoming = tuple(mask for view in views if (mask := datasets.load_mask(view)) is not None)
    if not any(((mask > 0) & (mask != masks.UNKNOWN)).any() for mask in incoming):
        raise errors.DatasetError(
            f"{dataset.mask_folder}: expected objects in the masks, found only background and unknown pixels; "
            "name other masks with --masks"
        )
    progress({"event": "draw", "done": 0, "total": len(views)})
    images = render_segments.draw(
        scene,
        views,
        incoming,
        backend=backend,
        progress=lambda done: progress({"event": "draw", "done": done, "total": len(views)}),
    )
    progress({"event": "prepare", "text": "associating segments"})
    _, neighbours = KDTree(scene.gaussians.means).query(
        scene.gaussians.means, min(NEIGHBOURS + 1, len(scene.gaussians.means)), workers=-1
    )
    times = sampling.spread(np.unique([view.t for view in views]).tolist(), TIMES)
    result = associate.associate(
        images,
        neighbours.reshape(len(scene.gaussians.means), -1)[:, 1:],
        paths=render_segments.paths(scene, np.array(times)),
    )
    made = render_votes.mend(scene, views, incoming, images, result, backend=backend)
    mended = tuple(mask.astype(np.uint16) for mask in made)
    return Repair(views, incoming, result, mended, own_ids=any(view.mask_video for view in views))


def check_place(folder: Path, views: Sequence[datasets.View]) -> None:
    """Raise DatasetError if a folder holds masks of these views that another tool made."""
    if mask_notes.read(folder).backend == BACKEND:
        return
    lost = [view.name for view in views if (folder / f"{view.name}.png").exists()]
    if lost:
        raise errors.DatasetError(
            f"{folder}: holds {len(lost)} masks that r5dgs associate did not write, such as {lost[0]}.png; name "
            "another folder with --out"
        )


def write(
    done: Repair,
    folder: Path,
    names: dict[int, str] | None,
    made_with: dict[str, Any],
    unmasked: Sequence[datasets.View] = (),
) -> dict[str, Any]:
    """Write the new masks, the list of segments and a summary; `train --masks` reads the folder.

    Files: masks named like their views; ``segments.csv``, one line per segment, changed ones first;
    ``association.json``, the summary; ``masks.json``; and ``objects.json`` if the ids belong to the folder.

    Args:
        done: Result of `repair`.
        folder: The folder; files of an earlier call are replaced.
        names: Names of the ids if they belong to the folder, with "object 3" as default; None if the ids are those of
            the data set.
        made_with: Inputs of the masks, for ``masks.json``.
        unmasked: Views of the data set without a mask; their old mask files are removed.

    Returns:
        Content of ``association.json``.

    Raises:
        DatasetError: A file cannot be written.
    """
    notes = mask_notes.MaskNotes(backend=BACKEND, finished=False, made_with=made_with)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        mask_notes.write(notes, folder)
        # Delete first, so that an interruption leaves missing masks instead of two numberings.
        for path in (folder / OBJECTS, *(folder / f"{view.name}.png" for view in (*done.views, *unmasked))):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise errors.DatasetError(f"{folder}: cannot be written: {error}") from error
    for view, ids in zip(done.views, done.mended, strict=True):
        masks.write(folder / f"{view.name}.png", ids)
    videos, found = _videos(done), summary(done)
    try:
        if names is not None:
            present = sorted({k for video in videos.values() for k in video.ids})
            called = {str(k): names.get(k, f"object {k}") for k in present}
            atomic_files.write(folder / OBJECTS, (json.dumps(called, indent=1) + "\n").encode())
        atomic_files.write(folder / SEGMENTS, _segments(done).encode())
        atomic_files.write(folder / SUMMARY, (json.dumps(found, indent=1) + "\n").encode())
    except OSError as error:
        raise errors.DatasetError(f"{folder}: cannot be written: {error}") from error
    mask_notes.write(dataclasses.replace(notes, numbering=done.numbering, finished=True, videos=videos), folder)
    return found


def _videos(done: Repair) -> dict[str, mask_notes.Video]:
    """Groups of images within which the new ids are valid, with their ids."""
    images: dict[str, list[str]] = {}
    found: dict[str, set[int]] = {}
    for view, ids in zip(done.views, done.mended, strict=True):
        name = view.mask_video if done.numbering == mask_notes.VIDEO else "all"
        images.setdefault(name, []).append(view.name)
        found.setdefault(name, set()).update(np.unique(ids).tolist())
    return {
        name: mask_notes.Video(tuple(some), tuple(sorted(found[name] - {0, masks.UNKNOWN})))
        for name, some in images.items()
    }


def summary(done: Repair) -> dict[str, Any]:
    """Summary of a repair, the content of ``association.json``."""
    result = done.result
    counts = {what: sum(row.done == what for row in result.rows) for what in ("kept", "relabelled", "unknown")}
    return {
        "images": len(done.views),
        "segments": len(result.rows),
        **counts,
        "mended": done.filled,
        "objects": [int(k) for k in result.objects],
        "confident": round(result.confident, 4),
        "agreement": round(result.agreement, 4),
        "agreement_before": round(result.agreement_before, 4),
        "usual_iou": round(result.usual_iou, 4),
        "fallback": result.fallback,
        "numbering": done.numbering,
    }


def switches(done: Repair) -> list[associate.SegmentResult]:
    """Segments that were relabelled or became unknown, the largest first."""
    changed = [row for row in done.result.rows if row.done != "kept"]
    return sorted(changed, key=lambda row: -row.pixels)


def _segments(done: Repair) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["image", "old_id", "new_id", "usual_id", "pixels", "score", "done"])
    changed = switches(done)
    for row in [*changed, *(row for row in done.result.rows if row.done == "kept")]:
        new = "unknown" if row.new_id == masks.UNKNOWN else row.new_id
        name = done.views[row.image].name
        table.writerow([name, row.old_id, new, row.usual_id, row.pixels, f"{row.score:.3f}", row.done])
    return text.getvalue()

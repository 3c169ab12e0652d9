"""Repair of a data set's masks: consistent object ids by associating the segments with a trained scene."""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import json
from collections.abc import Callable, Iterator, Sequence
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


class MaskFiles(Sequence[np.ndarray]):
    """Masks of views, read from their files on each access, so that long captures need no memory for them. [H, W]"""

    def __init__(self, views: Sequence[datasets.View]):
        self._views = views

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> np.ndarray:  # type: ignore[override]
        mask = datasets.load_mask(self._views[index])
        assert mask is not None
        return mask


@dataclass(frozen=True)
class Repair:
    """New ids of segments, and all that their masks are made from.

    Attributes:
        views: Views with masks, in the order of the association's images.
        incoming: Their original masks.
        result: New ids of segments.
        own_ids: True if the new ids belong to the folder, because those of the data set were valid per video only.
        mend: Yields the new masks, rendering the votes of other images; each call renders again.
    """

    views: tuple[datasets.View, ...]
    incoming: MaskFiles
    result: associate.Association
    own_ids: bool
    mend: Callable[[], Iterator[np.ndarray]]

    @property
    def mended(self) -> Iterator[np.ndarray]:
        """New masks; objects without a segment of their own may have gained pixels. [H, W] uint16"""
        return (mask.astype(np.uint16) for mask in self.mend())

    @property
    def numbering(self) -> str:
        """Scope of the new ids, as in `mask_notes`; if all incoming ids are kept, they remain valid per video."""
        apart = self.result.fallback and len({view.mask_video for view in self.views}) > 1
        return mask_notes.VIDEO if apart else mask_notes.SCENE


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
    incoming = MaskFiles(views)
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
    mend = functools.partial(render_votes.mend, scene, views, incoming, images, result, backend=backend)
    return Repair(views, incoming, result, any(view.mask_video for view in views), mend)


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
    present, filled = [], 0
    for image, (view, ids) in enumerate(zip(done.views, done.mended, strict=True)):
        masks.write(folder / f"{view.name}.png", ids)
        present.append(np.unique(ids))
        filled += _is_filled(done, image, ids)
    videos, found = _videos(done, present), summary(done, filled)
    try:
        if names is not None:
            ids = sorted({k for video in videos.values() for k in video.ids})
            called = {str(k): names.get(k, f"object {k}") for k in ids}
            atomic_files.write(folder / OBJECTS, (json.dumps(called, indent=1) + "\n").encode())
        atomic_files.write(folder / SEGMENTS, _segments(done).encode())
        atomic_files.write(folder / SUMMARY, (json.dumps(found, indent=1) + "\n").encode())
    except OSError as error:
        raise errors.DatasetError(f"{folder}: cannot be written: {error}") from error
    mask_notes.write(dataclasses.replace(notes, numbering=done.numbering, finished=True, videos=videos), folder)
    return found


def _is_filled(done: Repair, image: int, new: np.ndarray) -> bool:
    """Return True if pixels of an image changed beyond the relabelling of segments."""
    old = done.incoming[image]
    ids = np.unique(old[old != masks.UNKNOWN])
    return bool((mending.relabel(old, ids, done.result.ids[image]) != new).any())


def _videos(done: Repair, present: Sequence[np.ndarray]) -> dict[str, mask_notes.Video]:
    """Groups of images within which the new ids are valid, with the ids that are present in them."""
    images: dict[str, list[str]] = {}
    found: dict[str, set[int]] = {}
    for view, ids in zip(done.views, present, strict=True):
        name = view.mask_video if done.numbering == mask_notes.VIDEO else "all"
        images.setdefault(name, []).append(view.name)
        found.setdefault(name, set()).update(ids.tolist())
    return {
        name: mask_notes.Video(tuple(some), tuple(sorted(found[name] - {0, masks.UNKNOWN})))
        for name, some in images.items()
    }


def summary(done: Repair, filled: int) -> dict[str, Any]:
    """Summary of a repair with ``filled`` mended images, the content of ``association.json``."""
    result = done.result
    counts = {what: sum(row.done == what for row in result.rows) for what in ("kept", "relabelled", "unknown")}
    return {
        "images": len(done.views),
        "segments": len(result.rows),
        **counts,
        "mended": filled,
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

"""Association of the segments of all images to objects: identities that survive tracking errors.

Geometry and motion are trained first, so each segment is a weighted bag of Gaussians, and overlaps of bags replace the
tracker's guesses: between views, between times and across gaps. Tracklets, on which tracker and geometry agree
(`tracklets`), are joined to objects (`clustering`). Each image's segments are then assigned to objects by the votes of
the other images (`assignment`). Incoming ids are weighted by their measured reliability.

If the result explains the images no better than the incoming ids, all incoming ids are kept. Single segments with weak
evidence also keep theirs, translated to the new numbering.

Notation: I images, S segments of an image, N Gaussians, k neighbours, K objects.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, sparse

from ..data import masks
from . import assignment, clustering, leave_one_out, segment_stack, supergaussians, tracklet_overlaps, tracklets

GAIN = 0.5  # minimum mean gain per changed pixel, relative to the usual IoU, for many images
FEW = 4  # number of images at which the minimum gain is doubled, because little evidence can agree by chance
SHOWN = 0.03  # minimum share of the images that show an object, clamped to 2 to 4 images
MAX_WITHOUT_PATCHES = 60_000  # number of Gaussians above which neighbours are first grouped into patches
CERTAIN = 0.25  # minimum share of object pixels assigned with certainty; below it, all incoming ids are kept
DOUBTFUL = 0.55  # minimum margin of a certain assignment, see `assignment.Assignment.margins`

_NOBODY = -2  # temporary id of segments without an object


@dataclass(frozen=True)
class SegmentResult:
    """Result of the association for one segment.

    Attributes:
        image: Index of the image.
        segment: Index of the segment in its image, in the order of the incoming ids.
        old_id: Incoming id.
        new_id: Outgoing id, or `masks.UNKNOWN`.
        usual_id: Outgoing id of most pixels with the same incoming id in the same view.
        pixels: Size.
        score: Leave-one-out IoU with the object, relative to the usual IoU; 0 without an object.
        done: ``kept``: usual id, confirmed or for lack of evidence; ``relabelled``: corrected id switch; ``unknown``:
            no id.
    """

    image: int
    segment: int
    old_id: int
    new_id: int
    usual_id: int
    pixels: int
    score: float
    done: str


@dataclass(frozen=True)
class Association:
    """New ids for the segments of all images.

    Attributes:
        ids: New id of each segment of each image, 0 = background. List of I arrays [S] int32
        rows: One row per segment, without background.
        objects: Ids of the objects, ascending. [K]
        confident: Share of the objects' pixels that was assigned with certainty.
        agreement: Mean leave-one-out IoU of segments with their objects.
        agreement_before: The same with the incoming ids.
        usual_iou: Median leave-one-out IoU of segments; 1 for perfect geometry and outlines.
        fallback: True if all incoming ids are kept.
    """

    ids: list[np.ndarray]
    rows: list[SegmentResult]
    objects: np.ndarray
    confident: float
    agreement: float
    agreement_before: float
    usual_iou: float
    fallback: bool

    @functools.cached_property
    def sizes(self) -> dict[int, float]:
        """Median size of the segments of each outgoing id, pixels."""
        pixels: dict[int, list[int]] = {}
        for row in self.rows:
            pixels.setdefault(row.new_id, []).append(row.pixels)
        return {name: float(np.median(some)) for name, some in pixels.items()}


def associate(
    images: Sequence[segment_stack.ImageBags],
    neighbours: np.ndarray | None = None,
    *,
    paths: np.ndarray | None = None,
    most: int = MAX_WITHOUT_PATCHES,
) -> Association:
    """Find the objects that segments of many images show, and number the segments by object.

    Args:
        images: Bags of each image, see `segment_stack.from_pixels`.
        neighbours: Nearest Gaussians of each Gaussian; if None, Gaussians above ``most`` are dropped at random instead
            of being grouped. [N, k]
        paths: Positions of the Gaussians at some times; Gaussians that move apart are not grouped. [N, T, 3]
        most: Number of Gaussians above which neighbours are first grouped into patches.
    """
    if not images:
        raise ValueError("expected at least one image")
    count = images[0].weights.get_shape()[1]
    if count > most:
        groups = supergaussians.group(count, neighbours, paths, most)
        images = [replace(image, weights=supergaussians.pool(image.weights, groups)) for image in images]
    stack = segment_stack.stack(images)
    runs = tracklets.link(stack)
    if not (runs >= 0).any():
        return _untouched(stack, _plain(stack, 0.0), 0.0)
    labels, objects = _objects(stack, runs)
    found = assignment.refine(stack, runs, labels, objects)
    before = _incoming(stack)
    sure = (found.labels > 0) & (found.margins >= DOUBTFUL) & (found.scores >= assignment.LOWEST)
    shown = stack.ids > 0
    confident = float(stack.pixels[sure].sum() / max(stack.pixels[shown].sum(), 1))
    ids, usual = _name(stack, found, sure)
    changed = float(stack.pixels[shown & (ids != stack.ids)].sum() / max(stack.pixels[shown].sum(), 1))
    gain = found.agreement - before.agreement
    needed = GAIN * (1 + FEW / len(stack.views)) * found.usual_iou * changed
    if changed and (confident < CERTAIN or gain < needed):
        return _untouched(stack, before, confident)
    return _result(stack, ids, usual, found, confident, before.agreement)


def _objects(stack: segment_stack.SegmentStack, runs: np.ndarray) -> tuple[np.ndarray, int]:
    """Initial objects [S], 0 = background, -1 = none, and their number K."""
    of_runs = clustering.cluster(tracklet_overlaps.gather(stack, runs))
    labels = np.where(runs >= 0, of_runs[runs] + 1, 0)
    # Repeat with lower weights for Gaussians that several objects share, because they are misplaced.
    cast = sparse.csc_matrix(leave_one_out.cast(stack, labels, int(labels.max())))
    total = np.asarray(cast.sum(axis=1)).ravel()
    best = sparse.csr_matrix(cast[:, 1:].max(axis=1)).toarray().ravel()
    purity = sparse.diags(np.sqrt(best / np.maximum(total, 1e-9)).astype(np.float32))
    weighed = replace(
        stack, shared=sparse.csr_matrix(stack.shared @ purity), seen=sparse.csr_matrix(stack.seen @ purity)
    )
    of_runs = clustering.cluster(tracklet_overlaps.gather(weighed, runs))
    labels = np.where(runs >= 0, of_runs[runs] + 1, 0)
    fewest = int(np.clip(round(SHOWN * len(stack.views)), 2, 4))
    pairs = np.unique(np.stack([labels, stack.images]), axis=1)
    enough = np.bincount(pairs[0], minlength=labels.max() + 1) >= min(fewest, len(stack.views))
    enough[0] = False
    number = np.where(enough, np.cumsum(enough), -1)
    number[0] = 0
    return number[labels], int(enough.sum())


def _incoming(stack: segment_stack.SegmentStack) -> assignment.Assignment:
    """Evaluate the incoming ids as labels."""
    ids, labels = np.unique(np.where(stack.ids > 0, stack.ids, 0), return_inverse=True)
    labels = labels if ids[0] == 0 else labels + 1
    return assignment.measure(stack, labels, int(labels.max()))


def _name(
    stack: segment_stack.SegmentStack, found: assignment.Assignment, sure: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """New id of each segment, and the usual new id of its incoming id in its view. [S], [S]"""
    shown = np.flatnonzero(stack.ids > 0)
    number = int(found.labels.max(initial=0))  # -1 if no segment has an object and no image shows background
    old, at = np.unique(stack.ids[shown], return_inverse=True)
    overlap = np.zeros((number + 1, len(old)))
    good = found.labels[shown] > 0
    np.add.at(overlap, (found.labels[shown][good], at[good]), stack.pixels[shown][good])
    rows, columns = optimize.linear_sum_assignment(overlap[1:], maximize=True)
    names = np.zeros(number + 1, int)
    names[rows + 1] = np.where(overlap[rows + 1, columns] > 0, old[columns], 0)
    top, used = int(names.max()), set(names.tolist())
    above, below = range(top + 1, masks.UNKNOWN), range(1, top)
    fresh = (k for k in itertools.chain(above, below) if k not in used)
    for k in np.flatnonzero(names[1:] == 0) + 1:
        names[k] = next(fresh)
    tracks, track = np.unique(
        np.stack([stack.views[stack.images], np.where(stack.ids > 0, stack.ids, 0)]), axis=1, return_inverse=True
    )
    track = track.reshape(-1)
    tally = np.zeros((tracks.shape[1], number + 1))
    rows = np.flatnonzero(sure)
    np.add.at(tally, (track[rows], found.labels[rows]), stack.pixels[rows])
    tally[:, 0] = 0.0
    usual = np.where(tally.max(axis=1) > 0, names[tally.argmax(axis=1)], -1)
    for t in np.flatnonzero((usual < 0) & (tracks[1] > 0)):  # tracks without certain segments get a new id
        usual[t] = next(fresh)
    ids = np.where(stack.ids > 0, -1, 0)
    ids[sure] = names[found.labels[sure]]
    taken = set(zip(stack.images[sure].tolist(), ids[sure].tolist(), strict=True))
    for row in shown[np.argsort(-found.scores[shown], kind="stable")]:
        if ids[row] >= 0:
            continue
        for name in (int(usual[track[row]]), int(names[found.labels[row]]) if found.labels[row] > 0 else 0):
            if name and (int(stack.images[row]), name) not in taken:
                ids[row] = name
                taken.add((int(stack.images[row]), name))
                break
        else:
            ids[row] = _NOBODY
    return _compact(ids, usual[track])


def _compact(ids: np.ndarray, usual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber ids that exceed 16 bits, and replace `_NOBODY` by `masks.UNKNOWN`."""
    used = np.unique(np.concatenate([ids, usual]))
    used = used[used > 0]
    if len(used) and used[-1] >= masks.UNKNOWN:
        table = np.zeros(used[-1] + 1, int)
        table[used] = np.arange(1, len(used) + 1)
        ids, usual = (np.where(a > 0, table[np.maximum(a, 0)], a) for a in (ids, usual))
    return np.where(ids == _NOBODY, masks.UNKNOWN, ids), usual


def _result(
    stack: segment_stack.SegmentStack,
    ids: np.ndarray,
    usual: np.ndarray,
    found: assignment.Assignment,
    confident: float,
    agreement_before: float,
    fallback: bool = False,
) -> Association:
    ends = np.searchsorted(stack.images, np.arange(len(stack.views) + 1))
    rows = []
    for row in np.flatnonzero(stack.ids > 0):
        done = "unknown" if ids[row] == masks.UNKNOWN else "kept" if ids[row] == usual[row] else "relabelled"
        image = int(stack.images[row])
        rows.append(
            SegmentResult(
                image=image,
                segment=int(row - ends[image]),
                old_id=int(stack.ids[row]),
                new_id=int(ids[row]),
                usual_id=int(usual[row]),
                pixels=int(stack.pixels[row]),
                score=float(found.plain[row]),
                done=done,
            )
        )
    objects = np.unique(ids)
    return Association(
        ids=[ids[a:b].astype(np.int32) for a, b in zip(ends, ends[1:], strict=False)],
        rows=rows,
        objects=objects[(objects > 0) & (objects != masks.UNKNOWN)],
        confident=confident,
        agreement=found.agreement,
        agreement_before=agreement_before,
        usual_iou=found.usual_iou,
        fallback=fallback,
    )


def _untouched(stack: segment_stack.SegmentStack, found: assignment.Assignment, confident: float) -> Association:
    ids, usual = _compact(stack.ids, stack.ids)
    return _result(stack, ids, usual, found, confident, found.agreement, fallback=True)


def _plain(stack: segment_stack.SegmentStack, agreement: float) -> assignment.Assignment:
    nothing = np.zeros(len(stack.ids))
    return assignment.Assignment(np.zeros(len(stack.ids), int), nothing, nothing, nothing, agreement, 0.0)

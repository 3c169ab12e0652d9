"""Assignment of each image's segments to objects, one segment per object, by the votes of the other images.

Notation: S segments of all images, s of one image, K objects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from . import leave_one_out, segment_stack

PASSES = 3  # maximum number of passes of `refine`
STAY = 1.5  # factor on the score of a segment's previous object
LOWEST = 0.3  # minimum score, relative to the object's usual IoU
PART = 0.6  # minimum share of a part inside its object, relative to the usual share


@dataclass(frozen=True)
class Assignment:
    """Objects of segments.

    Attributes:
        labels: Object of each segment, 0 = background, -1 = none. [S]
        scores: Leave-one-out IoU with the object, relative to its usual IoU, averaged with the mean over its tracklet,
            times a bonus for the previous object; 0 without an object. [S]
        plain: Scores without the average over the tracklet and without the bonus. [S]
        margins: Score divided by the sum of it and the next best object's score; 0.5 is a tie. [S]
        agreement: Mean leave-one-out IoU per object pixel; the measure for comparing assignments.
        usual_iou: Median leave-one-out IoU of the segments with an object in the previous labels.
    """

    labels: np.ndarray
    scores: np.ndarray
    plain: np.ndarray
    margins: np.ndarray
    agreement: float
    usual_iou: float


def refine(stack: segment_stack.SegmentStack, runs: np.ndarray, labels: np.ndarray, count: int) -> Assignment:
    """Repeat `assign` until the labels are stable, at most `PASSES` times.

    Args:
        runs: Tracklet of each segment, -1 for background. [S]
        labels: Initial objects. [S]
        count: Number of objects.
    """
    found = assign(stack, runs, labels, count)
    for _ in range(PASSES - 1):
        if (found.labels == labels).all():
            break
        labels = found.labels
        found = assign(stack, runs, labels, count)
    return found


def assign(stack: segment_stack.SegmentStack, runs: np.ndarray, labels: np.ndarray, count: int) -> Assignment:
    """Reassign each segment by the votes of segments with the given labels; arguments as in `refine`."""
    found = list(leave_one_out.overlaps(stack, labels, count))
    ious = np.concatenate([overlap.ious for overlap in found])
    shares = np.concatenate([overlap.shares for overlap in found])
    objects = np.flatnonzero(stack.ids > 0)
    own = objects[labels[objects] > 0]
    usual = np.full(count + 1, np.median(ious[own, labels[own]]) if len(own) else 1.0)
    usual_share = float(np.median(shares[own, labels[own]])) if len(own) else 1.0
    for k in range(1, count + 1):
        mine = ious[own[labels[own] == k], k]
        usual[k] = (mine.sum() + 2 * usual[0]) / (len(mine) + 2)
    plain = ious / np.maximum(usual, 1e-6)
    # A lower usual IoU gives more weight to the mean over the tracklet.
    scores = usual[0] * plain + (1 - usual[0]) * _run_means(plain, runs, stack.pixels)
    scores[own, labels[own]] *= STAY
    scores[:, 0] = 0.0
    result = np.where(stack.ids > 0, -1, 0)
    reached, margins = np.zeros(len(result)), np.full(len(result), 0.5)
    ends = np.searchsorted(stack.images, np.arange(len(stack.views) + 1))
    for start, stop, overlap in zip(ends, ends[1:], found, strict=False):
        rows = objects[(objects >= start) & (objects < stop)]
        if not len(rows) or not count:
            continue
        table = scores[rows]
        at, to = optimize.linear_sum_assignment(np.where(table >= LOWEST, table, 0.0), maximize=True)
        good = table[at, to] >= LOWEST
        result[rows[at[good]]] = to[good]
        _add_parts(result, rows, start, overlap, usual_share)
        for row in rows[result[rows] > 0]:
            k = result[row]
            reached[row] = scores[row, k]
            others = np.delete(scores[row], k).max(initial=0.0)
            margins[row] = reached[row] / max(reached[row] + others, 1e-9)
    own = np.where(result > 0, np.take_along_axis(plain, np.maximum(result, 0)[:, None], axis=1)[:, 0], 0.0)
    return Assignment(result, reached, own, margins, _agreement(stack, ious, labels), float(usual[0]))


def measure(stack: segment_stack.SegmentStack, labels: np.ndarray, count: int) -> Assignment:
    """Evaluate given labels: scores, margins and mean agreement; arguments as in `refine`."""
    ious = np.concatenate([overlap.ious for overlap in leave_one_out.overlaps(stack, labels, count)])
    own = np.flatnonzero(labels > 0)
    scores = np.zeros(len(labels))
    scores[own] = ious[own, labels[own]]
    usual = float(np.median(scores[own])) if len(own) else 0.0
    plain = scores / max(usual, 1e-6)
    margins = np.full(len(labels), 0.5)
    return Assignment(labels, plain, plain, margins, _agreement(stack, ious, labels), usual)


def _agreement(stack: segment_stack.SegmentStack, ious: np.ndarray, labels: np.ndarray) -> float:
    rows = np.flatnonzero(stack.ids > 0)
    kept = np.where(labels[rows] > 0, ious[rows, np.maximum(labels[rows], 0)], 0.0)
    return float((kept * stack.pixels[rows]).sum() / max(stack.pixels[rows].sum(), 1))


def _add_parts(result: np.ndarray, rows: np.ndarray, start: int, overlap: leave_one_out.Overlaps, usual: float) -> None:
    """Assign leftover segments to an object that covers them, if that raises the object's IoU."""
    shares = overlap.shares
    for row in sorted(rows[result[rows] < 0], key=lambda r: -overlap.segments[r - start]):
        k = int(shares[row - start, 1:].argmax()) + 1
        if shares[row - start, k] < PART * usual:
            continue
        mine = rows[result[rows] == k] - start
        before, after = (_joint_iou(overlap, m, k) for m in (mine, np.append(mine, row - start)))
        if after > before:
            result[row] = k


def _joint_iou(overlap: leave_one_out.Overlaps, rows: np.ndarray, k: int) -> float:
    common = overlap.common[rows, k].sum()
    return common / max(overlap.segments[rows].sum() + overlap.objects[k] - common, 1e-9)


def _run_means(scores: np.ndarray, runs: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Mean over the segments of each tracklet, weighted by their sizes. [S, K + 1]"""
    out = np.zeros_like(scores)
    rows = np.flatnonzero(runs >= 0)
    if len(rows):
        sums = np.zeros((runs.max() + 1, scores.shape[1]))
        np.add.at(sums, runs[rows], scores[rows] * pixels[rows, None])
        sums /= np.bincount(runs[rows], pixels[rows])[:, None]
        out[rows] = sums[runs[rows]]
    return out

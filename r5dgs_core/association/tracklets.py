"""Tracklets: sequences of segments on which tracker and geometry agree.

Within a view, an incoming id is followed from image to image as long as the Gaussians agree. Otherwise a new tracklet
begins. An id switch therefore splits a tracklet, but never mixes two objects.

Notation: S segments, T tracklets, I images.
"""

from __future__ import annotations

import numpy as np

from . import segment_stack

FAINTEST = 0.02  # minimum IoU of consecutive segments of a tracklet


def link(stack: segment_stack.SegmentStack) -> np.ndarray:
    """Assign segments to tracklets.

    A segment continues the last segment with its id in its view if both are mutual best matches among the objects of
    the two images. The id may be missing in images between them.

    Returns:
        Tracklet of each segment, -1 for background. [S]
    """
    runs = np.full(len(stack.ids), -1)
    count = 0
    rows_of = _rows_of(stack)
    for view in np.unique(stack.views):
        images = np.flatnonzero(stack.views == view)
        last: dict[int, int] = {}  # row of the last segment of each id
        for image in images[np.argsort(stack.times[images], kind="stable")]:
            rows = rows_of[image]
            before: dict[int, list[int]] = {}
            for row in rows:
                if int(stack.ids[row]) in last:
                    before.setdefault(int(stack.images[last[int(stack.ids[row])]]), []).append(row)
            for earlier, continued in before.items():
                table = ious(stack, rows_of[earlier], rows)
                for row in continued:
                    at = (
                        int(np.searchsorted(rows_of[earlier], last[int(stack.ids[row])])),
                        int(np.searchsorted(rows, row)),
                    )
                    if table[at] >= max(table[at[0]].max(), table[:, at[1]].max(), FAINTEST):
                        runs[row] = runs[rows_of[earlier][at[0]]]
            for row in rows:
                if runs[row] < 0:
                    runs[row], count = count, count + 1
                last[int(stack.ids[row])] = row
    return runs


def ious(stack: segment_stack.SegmentStack, rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """IoU of segments of two images over the weight that both images show. [s], [t] -> [s, t]"""
    if not len(rows) or not len(others):
        return np.zeros((len(rows), len(others)))
    a, b = stack.shared[rows], stack.shared[others]
    common = (a @ b.T).toarray().astype(float)
    seen_a = (a @ stack.seen[stack.images[others[0]]].T).toarray()
    seen_b = (b @ stack.seen[stack.images[rows[0]]].T).toarray()
    return common / np.maximum(seen_a + seen_b.T - common, 1e-9)


def _rows_of(stack: segment_stack.SegmentStack) -> list[np.ndarray]:
    """Segments of each image, without background."""
    objects = np.flatnonzero(stack.ids > 0)
    ends = np.searchsorted(stack.images[objects], np.arange(len(stack.views) + 1))
    return [objects[a:b] for a, b in zip(ends, ends[1:], strict=False)]

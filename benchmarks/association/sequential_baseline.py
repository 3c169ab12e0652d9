"""Association image by image with a fixed threshold, as a baseline.

Images are processed in order and vote per Gaussian. A segment joins the object that its Gaussians voted for if their
IoU is above the threshold (Hungarian method, over Gaussians with votes), otherwise it becomes a new object. Objects in
fewer than 4 images are dropped, and every image is assigned again without its own votes, three times.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from r5dgs_core.association import leave_one_out, segment_stack

THRESHOLD = 0.25
MIN_IMAGES = 4
PASSES = 3


def associate(stack: segment_stack.SegmentStack, threshold: float = THRESHOLD, fewest: int = MIN_IMAGES) -> np.ndarray:
    """Object of each segment, 0 = background, -1 = none. [S]"""
    labels = np.where(stack.ids > 0, -1, 0)
    most = int((stack.ids > 0).sum())
    table = np.zeros((stack.weights.shape[1], 64), np.float32)
    count = 0
    order = np.lexsort((stack.views, stack.times))
    for image in order:
        rows = np.flatnonzero((stack.images == image) & (stack.ids > 0))
        bag = stack.weights[rows]
        weight = np.asarray(stack.weights[stack.images == image].sum(axis=0)).ravel()
        voted = table[:, : count + 1].sum(axis=1)
        shares = table[:, : count + 1] / np.maximum(voted, 1e-6)[:, None]
        common = np.asarray(bag @ shares)
        union = np.asarray(bag @ (voted > 0))[:, None] + (weight @ shares)[None] - common
        ious = common / np.maximum(union, 1e-9)
        ious[:, 0] = 0.0
        at, to = optimize.linear_sum_assignment(ious, maximize=True)
        for row, k, iou in zip(at, to, ious[at, to], strict=True):
            if iou > threshold:
                labels[rows[row]] = k
        for row in rows[labels[rows] < 0]:
            if count < min(most, table.shape[1] - 1):
                count += 1
                labels[row] = count
        for row in np.flatnonzero((stack.images == image) & (labels >= 0)):
            bag = stack.weights[row]
            table[bag.indices, labels[row]] += bag.data
    ends = np.searchsorted(stack.images, np.arange(len(stack.views) + 1))
    for _ in range(PASSES):
        shown = np.array([len(np.unique(stack.images[labels == k])) for k in range(count + 1)])
        labels = np.where((labels > 0) & (shown[labels] < fewest), -1, labels)
        found = np.full_like(labels, -1)
        found[stack.ids == 0] = 0
        for start, stop, overlap in zip(ends, ends[1:], leave_one_out.overlaps(stack, labels, count), strict=False):
            ious = overlap.ious * (stack.ids[start:stop] > 0)[:, None]
            ious[:, 0] = 0.0
            at, to = optimize.linear_sum_assignment(ious, maximize=True)
            good = ious[at, to] > threshold
            found[start + at[good]] = to[good]
        labels = found
    return labels

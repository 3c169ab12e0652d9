"""How well the id maps of a split overlap with its true masks: mIoU, said in full.

Pixels of all images are counted in one table, so an object that fills more of the images counts by its pixels within
its own IoU, and once in the mean. The background is measured apart, and pixels whose mask says nothing do not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..data import masks
from . import metrics

KEYS = ("miou", "miou_matched", "iou_background", "iou_objects", "iou_objects_matched", "id_map")
DEFINITION = (
    "mIoU: mean over the objects in the true masks of intersection / union, pixels of all images of a split together; "
    "matched ids: after the best one-to-one map of ids, one for the split (Hungarian); unknown pixels do not count"
)


def known(mask: np.ndarray) -> np.ndarray:
    """Where a true mask says what is there. [H, W] -> [H, W] bool"""
    return mask != masks.UNKNOWN


def objects_of(mask: np.ndarray) -> np.ndarray:
    """Where a true mask shows an object. [H, W] -> [H, W] bool"""
    return (mask > 0) & known(mask)


class Overlap:
    """Counts pixels by true and by rendered id.

    Args:
        ids: Objects of the scene; those of true masks join when they are first seen.
    """

    def __init__(self, ids: Iterable[int]) -> None:
        self.ids = list(ids)
        self.counts = np.zeros((len(self.ids) + 1, len(self.ids) + 1), np.int64)
        self.images = 0

    def add(self, rendered: np.ndarray, mask: np.ndarray) -> None:
        """Count an image.

        Args:
            rendered: Rendered ids, 0 = background. [H, W]
            mask: True ids; `masks.UNKNOWN` does not count. [H, W]
        """
        self.images += 1
        shown = np.unique(mask[objects_of(mask)])
        for object_id in sorted(set(shown.tolist()) - set(self.ids)):
            # An object that the scene lacks counts as missed; so far it was in no truth and in no prediction.
            self.counts = np.insert(np.insert(self.counts, len(self.ids), 0, axis=0), len(self.ids), 0, axis=1)
            self.ids.append(object_id)
        self.counts += metrics.confusion(rendered, mask, self.ids, known(mask))

    def result(self) -> dict[str, Any]:
        """What came of it, by `KEYS`, in JSON types.

        Returns:
            ``miou`` and ``miou_matched``; ``iou_background``; ``iou_objects`` and ``iou_objects_matched``, the IoU of
            each object that the masks show, by its true id as a string; ``id_map``, the rendered id (None for none)
            that the matched score takes for each. All None without an image, the scores without an object.
        """
        if not self.images:
            return dict.fromkeys(KEYS)
        table, present = metrics.ious(self.counts), metrics.present(self.counts)
        chosen = metrics.matched(self.counts)
        rows = np.flatnonzero(present).tolist()
        return {
            "miou": _finite(metrics.miou(self.counts)),
            "miou_matched": _finite(metrics.miou_matched(self.counts)),
            "iou_background": _finite(metrics.iou_of_rest(self.counts)),
            "iou_objects": {str(self.ids[k]): float(table[k, k]) for k in rows},
            "iou_objects_matched": {str(self.ids[k]): float(table[k, chosen[k]]) if k in chosen else 0.0 for k in rows},
            "id_map": {str(self.ids[k]): self.ids[chosen[k]] if k in chosen else None for k in rows},
        }


def _finite(value: float) -> float | None:
    return None if math.isnan(value) else value

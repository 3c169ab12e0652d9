"""Mean intersection over union (mIoU) of a split's id maps with its true masks.

Pixels of all images are pooled before the IoU of each object is computed; the mean weights all objects equally.
The background is measured separately, and pixels with an unknown mask value are ignored.
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
    "mIoU: mean over the objects in the true masks of intersection / union, pooled over all images of a split; "
    "matched ids: after the best one-to-one map of ids, one per split (Hungarian method); unknown pixels are ignored"
)


def known(mask: np.ndarray) -> np.ndarray:
    """Mask of the pixels whose true id is known. [H, W] -> [H, W] bool"""
    return mask != masks.UNKNOWN


def objects_of(mask: np.ndarray) -> np.ndarray:
    """Mask of the pixels that show an object. [H, W] -> [H, W] bool"""
    return (mask > 0) & known(mask)


class Overlap:
    """Counter of pixels by true and rendered id.

    Args:
        ids: Object ids of the scene; further ids of true masks are added when they first occur.
    """

    def __init__(self, ids: Iterable[int]) -> None:
        self.ids = list(ids)
        self.counts = np.zeros((len(self.ids) + 1, len(self.ids) + 1), np.int64)
        self.images = 0

    def add(self, rendered: np.ndarray, mask: np.ndarray) -> None:
        """Count the pixels of an image.

        Args:
            rendered: Rendered ids, 0 = background. [H, W]
            mask: True ids; pixels with `masks.UNKNOWN` are ignored. [H, W]
        """
        self.images += 1
        shown = np.unique(mask[objects_of(mask)])
        for object_id in sorted(set(shown.tolist()) - set(self.ids)):
            # An object missing from the scene counts as missed; no earlier truth or prediction contains it.
            self.counts = np.insert(np.insert(self.counts, len(self.ids), 0, axis=0), len(self.ids), 0, axis=1)
            self.ids.append(object_id)
        self.counts += metrics.confusion(rendered, mask, self.ids, known(mask))

    def result(self) -> dict[str, Any]:
        """Return the result by `KEYS`, in JSON types.

        Returns:
            ``miou`` and ``miou_matched``; ``iou_background``; ``iou_objects`` and ``iou_objects_matched``, the IoU of
            each object in the masks, by its true id as a string; ``id_map``, the rendered id that the matched score
            uses for each (None if unmatched). All are None without images; the scores are None without objects.
        """
        if not self.images:
            return dict.fromkeys(KEYS)
        table, present = metrics.iou_table(self.counts), metrics.present(self.counts)
        chosen = metrics.match_ids(self.counts)
        rows = np.flatnonzero(present).tolist()
        return {
            "miou": _finite(metrics.miou(self.counts)),
            "miou_matched": _finite(metrics.miou_matched(self.counts)),
            "iou_background": _finite(metrics.background_iou(self.counts)),
            "iou_objects": {str(self.ids[k]): float(table[k, k]) for k in rows},
            "iou_objects_matched": {str(self.ids[k]): float(table[k, chosen[k]]) if k in chosen else 0.0 for k in rows},
            "id_map": {str(self.ids[k]): self.ids[chosen[k]] if k in chosen else None for k in rows},
        }


def _finite(value: float) -> float | None:
    return None if math.isnan(value) else value

"""Segmentation of everything in one image with SAM2: prompts on a grid of points, filtered and deduplicated.

Notation: P points, an image of H x W pixels, masks of s x s from the network (a quarter of its input).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .sam2_model import Sam2

BATCH = 64  # points per forward pass
STABLE_BY = 1.0  # shift of the logit threshold in the stability test
SAME = 0.7  # IoU above which two masks are duplicates


@dataclass(frozen=True)
class SegmentSettings:
    """Criteria for accepting masks.

    Attributes:
        points: Grid points per side.
        score: Minimum IoU predicted by the network.
        stability: Minimum IoU of the masks at a lower and a higher threshold.
        min_area: Minimum area, as a share of the image; smaller masks are noise.
        max_area: Maximum area, as a share of the image; larger masks are background.
    """

    points: int = 32
    score: float = 0.8
    stability: float = 0.95
    min_area: float = 5e-4
    max_area: float = 0.4


@dataclass(frozen=True)
class Segment:
    """One mask of an image.

    Attributes:
        logits: Above 0 inside the mask, at the network's output size. [s, s] float32, on the CPU
        score: IoU predicted by the network.
    """

    logits: Tensor
    score: float

    @property
    def mask(self) -> np.ndarray:
        """Pixels of the segment. [s, s] bool"""
        return self.logits.gt(0).numpy()


@torch.inference_mode()
def find(model: Sam2, image: np.ndarray, settings: SegmentSettings) -> list[Segment]:
    """Segment an image.

    Args:
        image: RGB. [H, W, 3] uint8
        settings: Criteria for accepting masks.

    Returns:
        The masks, the best first; they may overlap, as parts and wholes do.
    """
    embeddings = model.image.get_image_embeddings(model.pixels(image))
    side = (torch.arange(settings.points, device=model.device) + 0.5) * (model.size / settings.points)
    grid = torch.stack(torch.meshgrid(side, side, indexing="xy"), -1).reshape(-1, 2)
    kept, scores = [], []
    for points in grid.split(BATCH):
        answer = model.image(
            image_embeddings=embeddings,
            input_points=points[None, :, None],
            input_labels=torch.ones(1, len(points), 1, dtype=torch.int32, device=model.device),
            multimask_output=True,
        )
        logits, score = answer.pred_masks[0].flatten(0, 1), answer.iou_scores[0].flatten()
        good = (score >= settings.score) & _is_good(logits, settings)
        kept.append(logits[good])
        scores.append(score[good])
    logits, score = torch.cat(kept), torch.cat(scores)
    return [Segment(logits[row].float().cpu(), float(score[row])) for row in _each_once(logits > 0, score)]


def new_ones(segments: Sequence[Segment], known: Sequence[np.ndarray], overlap: float) -> list[Segment]:
    """Filter out segments that match a known mask in the same image.

    Args:
        segments: Found segments.
        known: Masks of known objects. Sequence of [s, s] bool
        overlap: Minimum IoU at which a segment matches a mask.
    """
    pairs = [(segment, segment.mask) for segment in segments]
    return [segment for segment, mask in pairs if all(iou(mask, other) < overlap for other in known)]


def iou(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks, 0 if both are empty. [..., H, W] bool"""
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 0.0


def full_size(logits: Tensor, size: Sequence[int]) -> Tensor:
    """Resize network masks to the size of an image. [K, s, s] -> [K, H, W]"""
    return F.interpolate(logits[:, None].float(), tuple(size), mode="bilinear", align_corners=False)[:, 0]


def _is_good(logits: Tensor, settings: SegmentSettings) -> Tensor:
    """Select masks with a stable area when the threshold moves, within the area limits. [K, s, s] -> [K] bool"""
    strict, loose = ((logits > t).flatten(1).sum(1) for t in (STABLE_BY, -STABLE_BY))
    share = (logits > 0).flatten(1).float().mean(1)
    stable = strict >= settings.stability * loose.clamp(min=1)
    return stable & (share >= settings.min_area) & (share <= settings.max_area)


def _each_once(masks: Tensor, scores: Tensor) -> list[int]:
    """Non-maximum suppression: rows of the masks without a better duplicate, the best first. [K, s, s] bool, [K]"""
    flat = masks.flatten(1)
    areas = flat.sum(1)
    kept: list[int] = []
    for row in scores.argsort(descending=True, stable=True).tolist():
        common = (flat[kept] & flat[row]).sum(1)
        if kept and bool((common > SAME * (areas[kept] + areas[row] - common)).any()):
            continue
        kept.append(row)
    return kept

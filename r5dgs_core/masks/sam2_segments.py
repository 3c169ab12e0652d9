"""Everything that SAM2 sees in one image: masks at the points of a grid, the good ones of them, each thing once.

Notation: P points, an image of H x W pixels, masks of s x s out of the network (a quarter of its input).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .sam2_model import Sam2

BATCH = 64  # points that are asked at a time
STABLE_BY = 1.0  # logit by which the threshold is moved to see whether a mask stays the same
SAME = 0.7  # IoU above which two masks are one


@dataclass(frozen=True)
class SegmentSettings:
    """Which masks are taken.

    Attributes:
        points: Points of the grid per side.
        score: Least IoU with the truth that the network foretells.
        stability: Least IoU of the mask at a lower threshold with that at a higher one.
        min_area: Smaller masks are noise, as a share of the image.
        max_area: Larger masks are background, as a share of the image.
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
        logits: Above 0 where it is, in the size of the network's answers. [s, s] float32, on the CPU
        score: Its IoU with the truth, as the network foretells.
    """

    logits: Tensor
    score: float

    @property
    def mask(self) -> np.ndarray:
        """Where it is. [s, s] bool"""
        return self.logits.gt(0).numpy()


@torch.inference_mode()
def find(model: Sam2, image: np.ndarray, settings: SegmentSettings) -> list[Segment]:
    """Segment an image.

    Args:
        model: The model.
        image: RGB. [H, W, 3] uint8
        settings: Which masks are taken.

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
    """Segments that are none of the masks that are known in the same image.

    Args:
        segments: What was found.
        known: Masks of objects. [s, s] bool
        overlap: A segment whose IoU with one of them is this or more is that object.
    """
    pairs = [(segment, segment.mask) for segment in segments]
    return [segment for segment, mask in pairs if all(iou(mask, other) < overlap for other in known)]


def iou(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks, 0 where both are empty. [..., H, W] bool"""
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 0.0


def full_size(logits: Tensor, size: Sequence[int]) -> Tensor:
    """Masks out of the network in the size of an image. [K, s, s] -> [K, H, W]"""
    return F.interpolate(logits[:, None].float(), tuple(size), mode="bilinear", align_corners=False)[:, 0]


def _is_good(logits: Tensor, settings: SegmentSettings) -> Tensor:
    """Whether masks keep their area as the threshold moves, and have a sensible one. [K, s, s] -> [K] bool"""
    strict, loose = ((logits > t).flatten(1).sum(1) for t in (STABLE_BY, -STABLE_BY))
    share = (logits > 0).flatten(1).float().mean(1)
    stable = strict >= settings.stability * loose.clamp(min=1)
    return stable & (share >= settings.min_area) & (share <= settings.max_area)


def _each_once(masks: Tensor, scores: Tensor) -> list[int]:
    """Rows of the masks of which no better one is about the same, the best first. [K, s, s] bool, [K]"""
    flat = masks.flatten(1)
    areas = flat.sum(1)
    kept: list[int] = []
    for row in scores.argsort(descending=True, stable=True).tolist():
        common = (flat[kept] & flat[row]).sum(1)
        if kept and bool((common > SAME * (areas[kept] + areas[row] - common)).any()):
            continue
        kept.append(row)
    return kept

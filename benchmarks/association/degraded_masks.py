"""Tracker errors added to true masks, and measures of masks, for the benchmarks of association.

Masks are rows of pixels; 0 is background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize

from r5dgs_core.association.associate import SegmentResult
from r5dgs_core.data.masks import UNKNOWN

from .scenes import Image


@dataclass(frozen=True)
class Errors:
    """Errors added to masks.

    Attributes:
        per_view: True if each view has its own numbering.
        switches: Chance per object and time, from the second on, to swap its id permanently with another object.
        fragments: Chance per object and time, from the second on, to get a new id.
        misses: Chance per object and image that it is background.
        merges: Chance per image that the two nearest of three drawn objects have one id.
        edge_px: Length of the smooth random shifts of outlines, pixels.
        parts: Chance per object and image to be split into two ids.
    """

    per_view: bool = False
    switches: float = 0.0
    fragments: float = 0.0
    misses: float = 0.0
    merges: float = 0.0
    edge_px: float = 0.0
    parts: float = 0.0


_SPOILT = {"fragments": 0.02, "misses": 0.05, "merges": 0.10, "edge_px": 0.5}
CASES = {
    "A": Errors(switches=0.02),
    "B": Errors(switches=0.02, **_SPOILT),
    "C": Errors(per_view=True),
    "D": Errors(per_view=True, switches=0.02, **_SPOILT),
    "E": Errors(per_view=True, switches=0.06, fragments=0.04, misses=0.08, merges=0.15, edge_px=0.5),
    "F": Errors(per_view=True, switches=0.02, **_SPOILT, parts=0.10),
}


def spoil(images: Sequence[Image], errors: Errors, pixels: int, seed: int) -> list[np.ndarray]:
    """Masks with errors, one per image. [P] int32 each"""
    rng = np.random.default_rng(seed)
    bodies = max(int(image.truth.max()) for image in images)
    fresh = bodies + 1
    named: dict[int, np.ndarray] = {}
    spoilt = []
    for image in images:
        if image.view not in named:
            names = np.arange(bodies + 1)
            if errors.per_view:
                names[1:] = rng.permutation(bodies) + 1
            named[image.view] = names
        elif image.time:
            names = named[image.view]
            for body in range(1, bodies + 1):
                if bodies > 1 and rng.random() < errors.switches / 2:
                    other = rng.choice([b for b in range(1, bodies + 1) if b != body])
                    names[[body, other]] = names[[other, body]]
                if rng.random() < errors.fragments:
                    names[body], fresh = fresh, fresh + 1
        mask = _wobbled(image.truth, errors.edge_px, pixels, rng)
        out = named[image.view][mask]
        present = np.unique(mask[mask > 0])
        for body in present:
            if rng.random() < errors.parts:
                fresh = _split(out, mask == body, fresh, pixels, rng)
            if rng.random() < errors.misses:
                out[mask == body] = 0
        if len(present) > 1 and rng.random() < errors.merges:
            _merge(out, mask, present, pixels, rng)
        spoilt.append(out.astype(np.int32))
    return spoilt


def _wobbled(truth: np.ndarray, amount: float, pixels: int, rng: np.random.Generator) -> np.ndarray:
    """Shift the outlines smoothly at random, and a fifth of the pixels by one more pixel."""
    if not amount:
        return truth.copy()
    shifts = [ndimage.gaussian_filter(rng.normal(size=(pixels, pixels)), 2.0, mode="wrap") for _ in range(2)]
    shifts = [s / s.std() * amount for s in shifts]
    rough = [np.where(rng.random((pixels, pixels)) < 0.2, rng.integers(-1, 2, (pixels, pixels)), 0) for _ in range(2)]
    rows, columns = np.mgrid[:pixels, :pixels]
    rows, columns = (
        np.clip(np.rint(at + s + r).astype(int), 0, pixels - 1)
        for at, s, r in zip((rows, columns), shifts, rough, strict=True)
    )
    return truth.reshape(pixels, pixels)[rows, columns].reshape(-1)


def _split(out: np.ndarray, where: np.ndarray, fresh: int, pixels: int, rng: np.random.Generator) -> int:
    """Give one side of a line through the middle of an object a new id. Returns the next free id."""
    at = np.flatnonzero(where)
    xy = np.stack([at % pixels, at // pixels], axis=1) - np.mean([at % pixels, at // pixels], axis=1)
    angle = rng.uniform(0, 2 * np.pi)
    out[at[xy @ [np.cos(angle), np.sin(angle)] > 0]] = fresh
    return fresh + 1


def _merge(out: np.ndarray, mask: np.ndarray, present: np.ndarray, pixels: int, rng: np.random.Generator) -> None:
    drawn = rng.permutation(present)[:3]
    middles = [
        np.mean([np.flatnonzero(mask == b) % pixels, np.flatnonzero(mask == b) // pixels], axis=1) for b in drawn
    ]
    pairs = [(np.linalg.norm(middles[i] - middles[j]), i, j) for i in range(len(drawn)) for j in range(i)]
    _, i, j = min(pairs)
    out[mask == drawn[i]] = out[np.flatnonzero(mask == drawn[j])[0]]


def miou(masks: Sequence[np.ndarray], images: Sequence[Image]) -> float:
    """Mean IoU of the true objects after one one-to-one map of ids for all images (pooled pixels).

    The background is not an object; pixels that are background or unknown in the masks belong to no object.
    """
    truth, found = np.concatenate([image.truth for image in images]), np.concatenate(masks)
    _, truth = np.unique(truth, return_inverse=True)  # 0, background, is always seen
    values, found = np.unique(found, return_inverse=True)
    counts = np.zeros((truth.max() + 1, len(values)))
    np.add.at(counts, (truth, found), 1)
    named = (values > 0) & (values != UNKNOWN)
    table = (counts / (counts.sum(1)[:, None] + counts.sum(0)[None] - counts))[1:, named]
    rows, columns = optimize.linear_sum_assignment(table, maximize=True)
    return float(table[rows, columns].sum() / len(table))


def oracle(masks: Sequence[np.ndarray], images: Sequence[Image]) -> list[np.ndarray]:
    """Masks in which every segment has the true object of most of its pixels: the upper bound of relabelling."""
    best = []
    for mask, image in zip(masks, images, strict=True):
        out = np.zeros_like(mask)
        for name in np.unique(mask[mask > 0]):
            where = mask == name
            out[where] = np.argmax(np.bincount(image.truth[where]))
        best.append(out)
    return best


def majority(masks: Sequence[np.ndarray], images: Sequence[Image], count: int) -> list[np.ndarray]:
    """Baseline repair: each Gaussian gets its most frequent id, each segment the most frequent id of its Gaussians."""
    names, compact = np.unique(np.concatenate(masks), return_inverse=True)
    compact = compact.reshape(len(masks), -1)
    votes = np.zeros((count, len(names)), np.float32)
    for mask, image in zip(compact, images, strict=True):
        seen = image.indices[:, 0] >= 0
        np.add.at(votes, (image.indices[seen, 0], mask[seen]), 1.0)
    winner = votes.argmax(axis=1)
    repaired = []
    for mask, image in zip(compact, images, strict=True):
        seen, out = image.indices[:, 0] >= 0, np.zeros_like(mask)
        for name in np.unique(mask[mask > 0] if names[0] == 0 else mask):
            where = (mask == name) & seen
            if where.any():
                out[mask == name] = names[np.argmax(np.bincount(winner[image.indices[where, 0]]))]
        repaired.append(out)
    return repaired


def switches(
    masks: Sequence[np.ndarray], images: Sequence[Image], rows: Sequence[SegmentResult]
) -> tuple[float, float]:
    """Precision and recall of ``relabelled``: segments that show another object than their id mostly does in the view.

    NaN where there are none.
    """
    shown: dict[tuple[int, int], list[int]] = {}
    truths = []
    for row in rows:
        truth = int(np.argmax(np.bincount(images[row.image].truth[masks[row.image] == row.old_id])))
        truths.append(truth)
        counts = shown.setdefault((images[row.image].view, row.old_id), [])
        counts.extend([truth] * row.pixels)
    usual = {key: int(np.argmax(np.bincount(values))) for key, values in shown.items()}
    wrong = np.array([truth != usual[images[r.image].view, r.old_id] for truth, r in zip(truths, rows, strict=True)])
    named = np.array([row.done == "relabelled" for row in rows])
    hits = float((wrong & named).sum())
    return (hits / named.sum() if named.any() else np.nan, hits / wrong.sum() if wrong.any() else np.nan)

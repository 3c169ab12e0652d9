"""Balls among the bodies: centres and radius from the outlines in all views.

The outline of a ball does not change as it turns, so it gives the path of the ball's centre before any rotation is
known, and its radius. Something in front of a ball only cuts its outline, so points far inside count little.

Notation: E points of outlines, S knots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, ndimage

from ..scene import cameras
from .train_views import TrainView

POINTS = 80  # largest number of points of an outline
MIN_PIXELS = 12  # smallest mask
ROUNDS = 12  # fits with new weights
FINE = 0.02  # error of a point at which it counts half in the last fits, radii
SMOOTH = 0.1  # weight of squared second differences of the centres, against one point of an outline
CLOSE = 0.08  # largest error of a point of a ball's outline, radii
OUTSIDE = 0.05  # largest share of the points of a ball that lie farther outside
MIN_POINTS = 8  # smallest number of points of a view that counts for the depth
APART = np.radians(5.0)  # smallest angle between the directions of two such views
LEAST_MEASURED = 0.5  # smallest share of the knots at which the depth of a ball is known
INSIDE = 0.25  # largest share of them that lie farther inside, where something hides the ball


@dataclass(frozen=True)
class Outlines:
    """Points of the outlines of a body.

    Attributes:
        knots: Knot of each point. [E]
        eyes: Centre of its camera. [E, 3]
        rays: Unit direction to it. [E, 3]
        measured: Knots at which cameras in different directions show the body, so that its depth is known. [S] bool
    """

    knots: np.ndarray
    eyes: np.ndarray
    rays: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True)
class Ball:
    """A ball.

    Attributes:
        centers: Its centres at the knots. [S, 3]
        radius: Its radius.
        measured: Knots at which the outlines determine the centre; at others it is interpolated. [S] bool
    """

    centers: np.ndarray
    radius: float
    measured: np.ndarray


def box(mask: np.ndarray, object_id: int) -> tuple[slice, slice] | None:
    """Return the rows and columns of an object in a mask [H, W]; None if it shows too few pixels."""
    here = mask == object_id
    return ndimage.find_objects(here.astype(np.int8))[0] if here.sum() >= MIN_PIXELS else None


def outline(view: TrainView, mask: np.ndarray, object_id: int, rows: slice, columns: slice) -> np.ndarray:
    """Return rays through the edge of an object's box against things without an id, at most `POINTS`. [E, 3]"""
    top, bottom = max(rows.start - 1, 0), min(rows.stop + 1, mask.shape[0])
    left, right = max(columns.start - 1, 0), min(columns.stop + 1, mask.shape[1])
    part = mask[top:bottom, left:right]
    rays = cameras.pixel_rays(cameras.crop(view.camera, left, top, right - left, bottom - top))
    found = []
    for axis in (0, 1):
        first, second = (np.delete(part, end, axis) for end in (-1, 0))
        near, far = (np.delete(rays, end, axis) for end in (-1, 0))
        edge = ((first == object_id) & (second == 0)) | ((first == 0) & (second == object_id))
        found.append((near + far)[edge])
    points = np.concatenate(found)
    points = points[np.linspace(0, len(points) - 1, min(len(points), POINTS)).astype(int)]
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def gather(groups: Sequence[Sequence[TrainView]], object_ids: Sequence[int]) -> list[Outlines]:
    """Return the outlines of objects in the views of each knot [S]; each mask is read once."""
    found: list[list[tuple[int, np.ndarray, np.ndarray]]] = [[] for _ in object_ids]
    for s, views in enumerate(groups):
        for view in views:
            mask = view.mask
            for own, object_id in zip(found, object_ids, strict=True):
                where = None if mask is None else box(mask, object_id)
                if mask is not None and where is not None:
                    own.append((s, view.camera.center, outline(view, mask, object_id, *where)))
    return [_joined(own, len(groups)) for own in found]


def _joined(parts: Sequence[tuple[int, np.ndarray, np.ndarray]], count: int) -> Outlines:
    """Join the knots, camera centres and rays of the outlines of views; ``count`` is the number of knots."""
    sizes = [len(rays) for _, _, rays in parts]
    knots = np.repeat(np.array([s for s, _, _ in parts], int), sizes)
    eyes = np.repeat(np.array([eye for _, eye, _ in parts]).reshape(-1, 3), sizes, axis=0)
    directions: list[list[np.ndarray]] = [[] for _ in range(count)]
    for s, _, rays in parts:
        if len(rays) >= MIN_POINTS:
            mean = rays.mean(0)
            directions[s].append(mean / np.linalg.norm(mean))
    measured = np.array([len(ways) > 1 and np.min(ways @ np.transpose(ways)) < np.cos(APART) for ways in directions])
    return Outlines(knots, eyes, np.concatenate([np.zeros((0, 3)), *(rays for _, _, rays in parts)]), measured)


def second_differences(times: np.ndarray) -> np.ndarray:
    """Return the matrix of second differences of values at the times, scaled as in `Tracks.roughness`. [S - 2, S]"""
    step = np.diff(times)
    found = np.zeros((max(len(times) - 2, 0), len(times)))
    for k in range(len(found)):
        scale = 2 * step.mean() ** 2 / (step[k] + step[k + 1])
        found[k, k : k + 3] = scale / step[k], -scale * (1 / step[k] + 1 / step[k + 1]), scale / step[k + 1]
    return found


def fit(outlines: Outlines, centers: np.ndarray, times: np.ndarray) -> Ball | None:
    """Fit a ball to outlines; None if they are not those of a ball.

    Args:
        outlines: The outlines.
        centers: Approximate centres. [S, 3]
        times: Knots. [S]
    """
    count, knots = len(times), outlines.knots
    if count < 3 or len(knots) < 3 * count or outlines.measured.sum() < max(3, LEAST_MEASURED * count):
        return None
    bend = second_differences(times)
    smooth = np.zeros((9, 3 * count))  # upper bands of the normal matrix of smooth centres
    for k in range(3):
        products = np.einsum("ms,ms->s", bend[:, : count - k], bend[:, k:])
        smooth[8 - 3 * k, 3 * k :] = SMOOTH * np.repeat(products, 3)
    smooth[8] += 1e-6
    radius = float(np.quantile(np.linalg.norm(_arms(outlines, centers), axis=1), 0.75))
    for k in range(ROUNDS):
        if not radius > 0:
            return None
        arms = _arms(outlines, centers)
        distances = np.linalg.norm(arms, axis=1)
        wide = radius * max(0.1 * 0.6**k, FINE)
        weights = 1 / (1 + ((distances - radius) / wide) ** 2)
        ways = arms / np.maximum(distances, 1e-9 * radius)[:, None]
        change, growth = _step(knots, weights, ways, distances - radius, smooth, SMOOTH * bend.T @ (bend @ centers))
        centers, radius = centers - change, radius - growth
    if not (radius > 0 and np.isfinite(centers).all()):
        return None
    errors = np.linalg.norm(_arms(outlines, centers), axis=1) / radius - 1
    is_round = np.mean(errors > CLOSE) <= OUTSIDE and np.mean(errors < -CLOSE) <= INSIDE
    return Ball(centers, radius, outlines.measured) if is_round else None


def _step(
    knots: np.ndarray,
    weights: np.ndarray,
    ways: np.ndarray,
    misses: np.ndarray,
    smooth: np.ndarray,
    rough: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return the least-squares steps of the centres [S, 3] and of the radius, to be subtracted.

    Args:
        knots: Knots of the points. [E]
        weights: Their weights. [E]
        ways: Derivatives of their distances with respect to the centre. [E, 3]
        misses: Distances minus the radius. [E]
        smooth: Upper bands of the normal matrix of smooth centres. [9, 3 S]
        rough: Gradient of the roughness. [S, 3]
    """
    count = len(rough)
    bands, weighted = smooth.copy(), weights[:, None] * ways
    for i in range(3):
        for j in range(i, 3):
            bands[8 - (j - i), j::3] += np.bincount(knots, weighted[:, i] * ways[:, j], count)
    border = -np.stack([np.bincount(knots, weighted[:, i], count) for i in range(3)], 1).ravel()
    slope = np.stack([np.bincount(knots, weighted[:, i] * misses, count) for i in range(3)], 1) + rough
    along, across = linalg.solveh_banded(bands, np.stack([slope.ravel(), border], 1)).T
    growth = float((-weights @ misses - border @ along) / (weights.sum() + 1e-6 - border @ across))
    return (along - growth * across).reshape(count, 3), growth


def _arms(outlines: Outlines, centers: np.ndarray) -> np.ndarray:
    """Vectors from the nearest points of the rays to the centres. [E, 3]"""
    away = centers[outlines.knots] - outlines.eyes
    return away - (away * outlines.rays).sum(1, keepdims=True) * outlines.rays

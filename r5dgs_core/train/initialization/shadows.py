"""Direction of the light, estimated from the darkening of the supporting plane below moving objects.

A point x above the supporting plane n . x = h, lit along the direction l, casts its shadow on x - ((n . x - h) / (n .
l)) l. Below a moving object, the plane is darker there than usual. The direction with the largest mean darkening over
all objects, times and cameras is that of the light.

Notation: L candidate directions, M objects, S times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...scene.sampling import spread
from ..train_views import IMAGE, MASK, MAX_SAMPLE, TrainView, camera_key, in_turn, nearest_knot
from .background_images import BackgroundImage
from .plane_sweep import plane_axes
from .triangulation import ObjectPositions
from .visual_hull import pixel_indices

CANDIDATES = 400
LOWEST_SINE = 0.25  # below 15 degrees, shadows are too long to follow
MIN_DARKENING = 0.01  # share of brightness; less is no evidence of a direction
SAMPLES = 9  # sampled points per shadow


@dataclass(frozen=True)
class Light:
    """Unit direction in which light travels [3], and the measured darkening (0 if the direction is a default)."""

    direction: np.ndarray
    darkening: float


def find_light(
    views: Sequence[TrainView],
    backgrounds: Sequence[BackgroundImage],
    places: ObjectPositions,
    times: np.ndarray,
    plane: tuple[np.ndarray, float],
    rng: np.random.Generator,
) -> Light:
    """Estimate the direction of the light.

    Args:
        views: Training views; at most `MAX_SAMPLE` are used, spread evenly.
        backgrounds: Background image of each camera.
        places: Positions of the objects at each time.
        times: The observed times. [S]
        plane: Unit normal and offset of the supporting plane.
        rng: Random generator for the sampled points.

    Returns:
        The direction with the largest mean darkening; straight down if that is too small.
    """
    normal, height = plane
    directions = _directions(normal)
    score = np.zeros(len(directions))
    count = np.zeros(len(directions))
    background_of = {camera_key(b.camera): b for b in backgrounds}
    offsets = _disc(normal, rng)
    shown = [view for view in spread(views, MAX_SAMPLE) if camera_key(view.camera) in background_of]
    for view in in_turn(shown, IMAGE, MASK):
        background = background_of[camera_key(view.camera)]
        darkening, known = _darkening(view, background)
        s = nearest_knot(times, view.t)
        for row in np.flatnonzero(places.measured[:, s]):
            center = places.centers[row, s]
            above = center @ normal - height
            if above <= 0:
                continue
            shadow = center - above / (directions @ normal)[:, None] * directions
            points = shadow[:, None] + 0.6 * places.radii[row] * offsets
            columns, rows, valid = pixel_indices(view, points.reshape(-1, 3))
            seen = (valid & known[rows, columns]).reshape(len(directions), -1)
            values = np.where(seen, darkening[rows, columns].reshape(seen.shape), 0.0)
            score += values.sum(1)
            count += seen.sum(1)
    enough = count >= 0.2 * max(count.max(), 1)
    mean = np.where(enough, score / np.maximum(count, 1), -np.inf)
    best = int(np.argmax(mean))
    if mean[best] < MIN_DARKENING:
        return Light(-normal, 0.0)
    return Light(directions[best], float(mean[best]))


def cast(points: np.ndarray, light: np.ndarray, plane: tuple[np.ndarray, float]) -> np.ndarray:
    """Project points onto the plane along the light. [..., 3]"""
    normal, height = plane
    return points - ((points @ normal - height) / (light @ normal))[..., None] * light


def slope(light: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the shift of a shadow along the plane per unit that its caster rises. [3]"""
    return normal - light / (light @ normal)


def _directions(normal: np.ndarray) -> np.ndarray:
    """Return evenly spread directions towards the plane, straight down first. [L, 3]"""
    k = np.arange(CANDIDATES) + 0.5
    sine = 1 - (1 - LOWEST_SINE) * k / CANDIDATES
    angle = np.pi * (1 + 5**0.5) * k
    u, v = plane_axes(normal)
    cosine = np.sqrt(1 - sine**2)
    spread = cosine[:, None] * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v) - sine[:, None] * normal
    return np.concatenate([-normal[None], spread])


def _disc(normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(SAMPLES, 3))
    points -= (points @ normal)[:, None] * normal
    points *= np.sqrt(rng.random((SAMPLES, 1))) / np.linalg.norm(points, axis=1, keepdims=True)
    points[0] = 0.0
    return points


def _darkening(view: TrainView, background: BackgroundImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative loss of brightness in a view, and a mask of pixels where it is known. [H, W] each"""
    usual = background.image.mean(-1)
    now = view.image.mean(-1) / 255
    known = background.known & (usual > 0.02)
    mask = view.mask
    if mask is not None:
        known &= np.logical_not(ndimage.binary_dilation(mask > 0))
    return np.where(known, 1 - now / np.maximum(usual, 0.02), 0.0), known

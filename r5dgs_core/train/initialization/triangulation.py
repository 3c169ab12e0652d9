"""Positions of the objects at the observed times, triangulated from their masks.

The centroid of a mask gives a ray per view. One path per object is fitted to the rays of all times, close to the rays
and with small acceleration. If several views show the object, their rays determine its position; otherwise the path
continues smoothly, and at constant velocity beyond the last sighting.

Notation: M objects, S observed times, V views. The path's time u runs from 0 to 1 over the observed span.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...data import masks
from ...scene.cameras import Camera
from ..train_views import MASK, TrainView, in_turn, nearest_knot

log = logging.getLogger(__name__)

RAY_NOISE = 0.01  # standard deviation of a centroid's ray from the object's centre, normalised units
ACCELERATION = 10.0  # standard deviation of the path's acceleration, units per squared span (as of a thrown object)
VELOCITY = 30.0  # standard deviation of its velocity, units per span; long gaps slowly bring the path to rest
DEPTH_NOISE = 3.0  # standard deviation of the depth about its prior, the cameras' focus, normalised units
CUT_OFF = 0.003  # weight of masks that the image border cuts
PLACED = 0.05  # maximum standard deviation of a measured position, normalised units
MIN_VISIBLE_AREA = (
    0.5  # minimum visible area of an object whose pose training determines, relative to the median over time
)
ROUNDS = 5
NAMED = 8  # maximum number of objects that a warning names


@dataclass(frozen=True)
class ObjectPositions:
    """Positions of the objects over time.

    Attributes:
        object_ids: Ids that occur in the masks. [M]
        centers: Centres; unmeasured ones are on a smooth path through the others. [M, S, 3]
        measured: Times at which the masks determine the centre. [M, S] bool
        visibility: Share of the views at that time that show the whole object, weighted by its area. [M, S]
        radii: Radius of a ball that contains the object. [M]
        evidence: Visible area of the object relative to its median over time, at most 1. [M, S]
        shown: Times at which training can determine the pose: the centre is measured, or two cameras show most of the
            object, cut by the image border or not. [M, S] bool
    """

    object_ids: np.ndarray
    centers: np.ndarray
    measured: np.ndarray
    visibility: np.ndarray
    radii: np.ndarray
    evidence: np.ndarray
    shown: np.ndarray


@dataclass(frozen=True)
class _Sighting:
    knot: int
    origin: np.ndarray
    ray: np.ndarray
    area: int
    weight: float
    angular_radius: float
    whole: bool


def locate(views: Sequence[TrainView], times: np.ndarray, min_share: float) -> ObjectPositions:
    """Locate every object at every observed time.

    Args:
        views: Training views; those without a mask are ignored.
        times: Observed times, increasing. [S]
        min_share: Minimum size of a mask to use, as a share of the image.

    Returns:
        The positions. An object that is never visible from two sides gets the depth of the cameras' focus. An object in
        a single mask is left out, as its position is unknown and the mask is most likely wrong.
    """
    found = _sightings(views, times, min_share)
    ids = np.array(sorted(found), np.int64)
    m, count = len(ids), len(times)
    centers = np.zeros((m, count, 3))
    measured = np.zeros((m, count), bool)
    visibility, evidence = np.zeros((m, count)), np.zeros((m, count))
    from_two = np.zeros((m, count), bool)
    radii = np.zeros(m)
    guessed = []
    for row, object_id in enumerate(ids):
        seen = found[int(object_id)]
        for x in seen:
            visibility[row, x.knot] += x.weight * x.whole
            evidence[row, x.knot] += x.area
            from_two[row, x.knot] |= any(y.knot == x.knot and (y.origin != x.origin).any() for y in seen)
        used = _votes(seen)
        centers[row], measured[row] = _path(used, times)
        if not measured[row].any():
            guessed.append(int(object_id))
            measured[row, [x.knot for x in seen]] = True
        sizes = [x.angular_radius * np.linalg.norm(centers[row, x.knot] - x.origin) for x in used]
        radii[row] = np.quantile(sizes, 0.8)
        evidence[row] /= np.median(evidence[row][evidence[row] > 0])
    if guessed:
        log.warning(
            "%s never fully visible from two sides, so its depth is a guess. Remedy: more cameras at the same times, "
            "or masks that follow it",
            _named(guessed),
        )
    peak = visibility.max(axis=1, keepdims=True) if m else visibility
    shown = measured | (from_two & (evidence >= MIN_VISIBLE_AREA))
    visibility = visibility / np.maximum(peak, 1e-12)
    return ObjectPositions(ids, centers, measured, visibility, radii, np.minimum(evidence, 1.0), shown)


def _sightings(views: Sequence[TrainView], times: np.ndarray, min_share: float) -> dict[int, list[_Sighting]]:
    """Return the sightings of each object that more than one mask shows."""
    found: dict[int, list[_Sighting]] = {}
    masked = [v for v in views if v.has_mask]
    for view in in_turn(masked, MASK):
        s, mask = nearest_knot(times, view.t), view.mask
        assert mask is not None
        for object_id, box in enumerate(ndimage.find_objects(mask), 1):
            if box is not None and object_id != masks.UNKNOWN:
                sighting = _sight(view.camera, mask, box, s, object_id, min_share)
                if sighting is not None:
                    found.setdefault(object_id, []).append(sighting)
    single = sorted(i for i, seen in found.items() if len(seen) == 1 and len(masked) > 1)
    if single:
        log.warning(
            "%s shown by one mask only and treated as background. Remedy: correct the id in that mask, or add masks of "
            "the object in other views",
            _named(single),
        )
    return {i: seen for i, seen in found.items() if i not in set(single)}


def _named(ids: Sequence[int]) -> str:
    """Return the subject and the verb of a message about some objects."""
    if len(ids) == 1:
        return f"object {ids[0]} is"
    more = f" and {len(ids) - NAMED} more" if len(ids) > NAMED else ""
    return f"objects {', '.join(map(str, ids[:NAMED]))}{more} are each"


def _sight(
    camera: Camera, ids: np.ndarray, box: tuple[slice, slice], knot: int, object_id: int, min_share: float
) -> _Sighting | None:
    """Return the sighting of an object whose pixels lie in a box of the mask, None if it is too small there."""
    rows, cols = np.nonzero(ids[box] == object_id)
    area = len(rows)
    if area < max(6, min_share * ids.size):
        return None
    rows, cols = rows + box[0].start, cols + box[1].start
    height, width = ids.shape
    whole = rows.min() > 0 and cols.min() > 0 and rows.max() < height - 1 and cols.max() < width - 1
    k = camera.intrinsics
    u = (cols.mean() + 0.5 - k[0, 2]) / k[0, 0]
    v = (rows.mean() + 0.5 - k[1, 2]) / k[1, 1]
    ray = np.array([u, v, 1.0]) @ camera.T_cam_world[:3, :3]
    reach = np.hypot((cols - cols.mean()) / k[0, 0], (rows - rows.mean()) / k[1, 1]).max() + 0.5 / k[0, 0]
    norm = np.linalg.norm(ray)
    weight = float(np.sqrt(area) * (1 - _touching(ids, object_id, rows, cols)) ** 2)
    return _Sighting(knot, camera.center, ray / norm, area, weight, float(reach / norm), bool(whole))


def _touching(mask: np.ndarray, object_id: int, rows: np.ndarray, cols: np.ndarray) -> float:
    """Share of an object's outline that borders on other objects, 0 to 1."""
    part = mask[max(rows.min() - 1, 0) : rows.max() + 2, max(cols.min() - 1, 0) : cols.max() + 2]
    here = part == object_id
    ring = ndimage.binary_dilation(here) & ~here
    return float((part[ring] > 0).mean()) if ring.any() else 0.0


def _votes(seen: Sequence[_Sighting]) -> list[_Sighting]:
    """Return the sightings to use: at times with at least two sightings of the whole object, only these."""
    whole = np.zeros(max(x.knot for x in seen) + 1, np.int64)
    for x in seen:
        whole[x.knot] += x.whole
    return [x for x in seen if x.whole or whole[x.knot] < 2]


def _path(seen: Sequence[_Sighting], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the path nearest to the rays of the sightings (iteratively reweighted least squares).

    Rays with large residuals (masks cut by an occluder) and accelerations much larger than expected (impacts) are
    down-weighted.

    Returns:
        Centres [S, 3], and a mask of the times at which rays determine them [S] bool.
    """
    count = len(times)
    at = np.array([x.knot for x in seen])
    origins, rays = np.stack([x.origin for x in seen]), np.stack([x.ray for x in seen])
    weights = np.array([x.weight * (1.0 if x.whole else CUT_OFF) for x in seen])
    if not weights.any():  # other objects surround it in all masks
        weights = np.ones(len(seen))
    weights = weights / weights.max()
    projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    guesses = origins + rays * np.linalg.norm(origins, axis=1, keepdims=True)
    bends, bend_weights = _bends(times)
    robust, kinks = _agreement(seen, weights, projectors, origins), np.ones(len(bends))
    path = covariance = np.zeros(0)
    for _ in range(ROUNDS):
        precision = (weights * robust)[:, None, None] * projectors / RAY_NOISE**2
        near = np.eye(3) * (weights / DEPTH_NOISE**2)[:, None, None]
        smooth = bends.T @ ((bend_weights * kinks)[:, None] * bends)
        system = np.zeros((count, 3, count, 3))
        right = np.zeros((count, 3))
        for axis in range(3):
            system[:, axis, :, axis] += smooth
        diagonal = np.zeros((count, 3, 3))
        np.add.at(diagonal, at, precision + near)
        system[np.arange(count), :, np.arange(count), :] += diagonal
        np.add.at(right, at, np.einsum("nij,nj->ni", precision, origins) + np.einsum("nij,nj->ni", near, guesses))
        covariance = np.linalg.inv(system.reshape(3 * count, 3 * count))
        path = (covariance @ right.reshape(-1)).reshape(count, 3)
        gaps = np.linalg.norm(np.einsum("nij,nj->ni", projectors, path[at] - origins), axis=1)
        robust = 1 / (1 + (gaps / max(2 * 1.48 * np.median(gaps), RAY_NOISE)) ** 2)
        kinks = 1 / (1 + bend_weights * ((bends @ path) ** 2).sum(1) / 9)
    blocks = covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :]
    measured = np.zeros(count, bool)
    ahead = ((path[at] - origins) * rays).sum(1) > 0
    measured[at] = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])[at] < PLACED
    measured[at[~ahead]] = False
    return path, measured


def _bends(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return accelerations and velocities as linear maps of a path's positions [B, S], and their precisions [B]."""
    count = len(times)
    if count < 2:
        return np.zeros((0, count)), np.zeros(0)
    u = (times - times[0]) / (times[-1] - times[0])
    h = np.diff(u)
    secants = (np.eye(count)[1:] - np.eye(count)[:-1]) / h[:, None]
    middle = 0.5 * (h[1:] + h[:-1])
    accelerations = np.diff(secants, axis=0) / middle[:, None]
    share = np.concatenate([middle, h]) * (count - 1)  # in mean intervals
    noise = np.repeat([ACCELERATION, VELOCITY], [count - 2, count - 1])
    return np.concatenate([accelerations, secants]), share / noise**2


def _agreement(
    seen: Sequence[_Sighting], weights: np.ndarray, projectors: np.ndarray, origins: np.ndarray
) -> np.ndarray:
    """Return the agreement of each ray with the others of its time, in (0, 1]; 1 if the point is not determined. [n]"""
    at = np.array([x.knot for x in seen])
    agreement = np.ones(len(seen))
    for s in np.unique(at):
        rows = np.flatnonzero(at == s)
        for _ in range(4):
            w = weights[rows] * agreement[rows]
            system = np.einsum("n,nij->ij", w, projectors[rows])
            if len(rows) < 3 or np.linalg.eigvalsh(system / w.sum())[0] < 1e-4:
                break
            point = np.linalg.solve(system, np.einsum("n,nij,nj->i", w, projectors[rows], origins[rows]))
            gaps = np.linalg.norm(np.einsum("nij,nj->ni", projectors[rows], point - origins[rows]), axis=1)
            agreement[rows] = 1 / (1 + (gaps / (2 * 1.48 * np.median(gaps) + 1e-9)) ** 2)
    return agreement

"""Where each object is at each observed time, from its masks alone.

A mask's centroid gives a ray per view; the point nearest to the rays of one time is the object's place (least squares,
reweighted against masks that are cut off by something in front).

Notation: M objects, S observed times, V views.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .views import TrainView, nearest_knot

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Places:
    """Places of the objects over time.

    Attributes:
        object_ids: Ids that occur in the masks. [M]
        centers: Triangulated centres; filled in from neighbouring times where not measured. [M, S, 3]
        measured: Times at which the centre was triangulated. [M, S] bool
        visibility: Share of the views at that time that show the whole object, weighted by its area. [M, S]
        radii: Radius of a ball that holds the object. [M]
    """

    object_ids: np.ndarray
    centers: np.ndarray
    measured: np.ndarray
    visibility: np.ndarray
    radii: np.ndarray


@dataclass(frozen=True)
class _Sighting:
    origin: np.ndarray
    ray: np.ndarray
    weight: float
    angular_radius: float
    whole: bool


def locate(views: Sequence[TrainView], times: np.ndarray, min_share: float) -> Places:
    """Triangulate every object at every observed time.

    Args:
        views: Training views; those without a mask are passed over.
        times: Observed times, increasing. [S]
        min_share: Smaller masks do not vote, as a share of the image.

    Returns:
        The places; objects that are nowhere seen by two views at one time get the depth of the cameras' focus.
    """
    sightings: dict[int, dict[int, list[_Sighting]]] = {}
    for view in views:
        if view.mask is None:
            continue
        s = nearest_knot(times, view.t)
        for object_id in np.unique(view.mask):
            if object_id <= 0:
                continue
            sighting = _sight(view, view.mask == object_id, min_share)
            if sighting is not None:
                sightings.setdefault(int(object_id), {}).setdefault(s, []).append(sighting)
    ids = np.array(sorted(sightings), np.int64)
    m, count = len(ids), len(times)
    centers = np.full((m, count, 3), np.nan)
    visibility = np.zeros((m, count))
    radii = np.zeros(m)
    for row, object_id in enumerate(ids):
        sizes = []
        for s, seen in sightings[int(object_id)].items():
            visibility[row, s] = sum(x.weight for x in seen if x.whole)
            whole = [x for x in seen if x.whole] if sum(x.whole for x in seen) >= 2 else seen
            center = _nearest_point(whole)
            if center is not None:
                centers[row, s] = center
                sizes += [x.angular_radius * np.linalg.norm(center - x.origin) for x in whole]
        if np.isnan(centers[row]).all():
            log.warning(
                "object %d is never seen whole enough by two cameras at one time: its depth is a guess. "
                "Remedy: more cameras at the same times, or masks that follow it",
                object_id,
            )
            for s, seen in sightings[int(object_id)].items():
                best = max(seen, key=lambda x: x.weight)
                centers[row, s] = best.origin + best.ray * np.linalg.norm(best.origin)
                sizes.append(best.angular_radius * np.linalg.norm(best.origin))
        radii[row] = np.quantile(sizes, 0.8) if sizes else 0.1
    measured = np.asarray(~np.isnan(centers).any(-1))
    for row in range(m):
        known = np.flatnonzero(measured[row])
        for axis in range(3):
            centers[row, :, axis] = np.interp(times, times[known], centers[row, known, axis])
    peak = visibility.max(axis=1, keepdims=True) if m else visibility
    return Places(ids, centers, measured, visibility / np.maximum(peak, 1e-12), radii)


def _sight(view: TrainView, mask: np.ndarray, min_share: float) -> _Sighting | None:
    area = int(mask.sum())
    if area < max(6, min_share * mask.size):
        return None
    rows, cols = np.nonzero(mask)
    height, width = mask.shape
    whole = rows.min() > 0 and cols.min() > 0 and rows.max() < height - 1 and cols.max() < width - 1
    k = view.camera.intrinsics
    u = (cols.mean() + 0.5 - k[0, 2]) / k[0, 0]
    v = (rows.mean() + 0.5 - k[1, 2]) / k[1, 1]
    ray = np.array([u, v, 1.0]) @ view.camera.T_cam_world[:3, :3]
    reach = np.hypot((cols - cols.mean()) / k[0, 0], (rows - rows.mean()) / k[1, 1]).max() + 0.5 / k[0, 0]
    norm = np.linalg.norm(ray)
    return _Sighting(view.camera.center, ray / norm, float(np.sqrt(area)), float(reach / norm), bool(whole))


def _nearest_point(seen: list[_Sighting]) -> np.ndarray | None:
    if len(seen) < 2:
        return None
    origins = np.stack([x.origin for x in seen])
    rays = np.stack([x.ray for x in seen])
    weights = np.array([x.weight for x in seen])
    projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    robust = np.ones(len(seen))
    point = None
    for _ in range(4):
        system = np.einsum("n,nij->ij", weights * robust, projectors)
        if np.linalg.eigvalsh(system / weights.sum())[0] < 1e-4:
            return point
        point = np.linalg.solve(system, np.einsum("n,nij,nj->i", weights * robust, projectors, origins))
        gaps = np.linalg.norm(np.einsum("nij,nj->ni", projectors, point - origins), axis=1)
        scale = 2 * 1.48 * np.median(gaps) + 1e-9
        robust = 1 / (1 + (gaps / scale) ** 2)
    behind = (rays @ point - np.einsum("nj,nj->n", rays, origins)) <= 0
    return None if behind.any() else point

"""Convex hulls of a scene's objects, one for each object and motion.

Objects that are nearly balls or boxes get these, which the hull of silhouettes is not: it bulges over faces.
"""

from __future__ import annotations

import numpy as np

from ..scene.hull import Hull
from ..scene.scene import Scene
from ..scene.splats import to_opacities
from . import balls, boxes, silhouette_hull, silhouettes

_FILTER = 0.3  # variance that the low-pass filter of pictures adds to Gaussians, px^2
# Opacity at the outlines of pictures with that filter; at 0.5, eight trained balls and boxes are 2 % larger.
_LEVEL = 0.6


def of(scene: Scene) -> tuple[Hull, ...]:
    """Return the hulls of a scene, in the bind state. Objects that are nowhere solid have none."""
    found = []
    for object_id, motion_id in sorted(bodies(scene)):
        rows = np.flatnonzero(_members(scene, object_id, motion_id))
        gaussians = scene.gaussians
        means, quats = gaussians.means[rows], gaussians.quats[rows]
        scales = np.exp(gaussians.log_scales[rows].astype(np.float64))
        opacities = to_opacities(gaussians.opacity_logits[rows])
        hull = silhouette_hull.of(means, quats, scales, opacities)
        if hull is None:
            continue
        simple = _simple(means, quats, np.sqrt(scales**2 + _FILTER * _pixel(scene, means) ** 2), opacities)
        found.append(Hull(object_id, motion_id, *(simple or hull)))
    return tuple(found)


def _simple(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray
) -> silhouette_hull.SilhouetteHull | None:
    """Ball or box that an object is nearly, or None, from Gaussians as large as in the pictures of training.

    The Gaussians alone are too small: training fits them together with the low-pass filter of the pictures.
    """
    outlines = silhouettes.of(means, quats, scales, opacities, _LEVEL)
    if not outlines:
        return None
    planes = silhouettes.tangents(outlines)
    vertices = balls.of(*planes)
    vertices = boxes.of(*planes) if vertices is None else vertices
    if vertices is None:
        return None
    return silhouette_hull.SilhouetteHull(vertices, silhouette_hull.error(vertices, outlines))


def _pixel(scene: Scene, means: np.ndarray) -> float:
    """Width of a pixel at an object in the middle one of the scene's cameras, world units; 0 without cameras."""
    place, found = means.astype(np.float64).mean(axis=0), []
    for camera in scene.cameras:
        depth = float(camera.T_cam_world[2, :3] @ place + camera.T_cam_world[2, 3])
        if depth > 0:
            found.append(depth / float(camera.intrinsics[0, 0]))
    return float(np.median(found)) if found else 0.0


def bodies(scene: Scene) -> set[tuple[int, int]]:
    """Return the pairs of object and motion group that are solid bodies.

    These are the groups of the object itself, not shadows or Gaussians that move with another object. The
    resting Gaussians of an object count only if none of its Gaussians move.
    """
    found = set()
    for item in scene.objects:
        if item.id <= 0:
            continue
        motions = np.unique(scene.gaussians.motion_ids[item.start : item.start + item.count]).tolist()
        own = [m for m in motions if scene.groups[m].role == "body" and scene.groups[m].object_id == item.id]
        found |= {(item.id, motion) for motion in own or motions[:1] if scene.groups[motion].role != "shadow"}
    return found


def _members(scene: Scene, object_id: int, motion_id: int) -> np.ndarray:
    return (scene.gaussians.object_ids == object_id) & (scene.gaussians.motion_ids == motion_id)

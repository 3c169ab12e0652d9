"""Convex hulls of a scene's objects, one for each object and motion."""

from __future__ import annotations

import numpy as np

from ..scene.hull import Hull
from ..scene.scene import Scene
from ..scene.splats import to_opacities
from . import silhouette_hull


def of(scene: Scene) -> tuple[Hull, ...]:
    """Return the hulls of a scene, in the bind state. Objects that are nowhere solid have none."""
    found = []
    for object_id, motion_id in sorted(bodies(scene)):
        rows = np.flatnonzero(_members(scene, object_id, motion_id))
        gaussians = scene.gaussians
        scales = np.exp(gaussians.log_scales[rows].astype(np.float64))
        opacities = to_opacities(gaussians.opacity_logits[rows])
        hull = silhouette_hull.of(gaussians.means[rows], gaussians.quats[rows], scales, opacities)
        if hull is not None:
            found.append(Hull(object_id, motion_id, hull.vertices, hull.error))
    return tuple(found)


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

"""Adjustment of the cameras of a run to patches of its images, with the depth of the scene so far."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ...data import masks
from ...raster import rasterize_splats
from ...raster.arrays import to_host
from ...scene.camera_correction import POSE, TIME
from ...scene.sampling import spacing, spread
from ..train_views import TrainView
from ..trainer import Trainer
from . import agreement, gauge, patch_adjustment, patches
from .patch_adjustment import Cameras
from .patches import DepthView, Patches
from .refinement import CLOCKS, POSES

log = logging.getLogger(__name__)

MOMENTS = 10  # times whose pictures are compared
PATCHES = 4000  # in all pictures
MANY = 2  # factor of both for an adjustment of the clocks alone, which only moving surfaces determine
MOST_POSES = 24
FAR = 1.0  # change of the poses after which the depth of the scene is not good enough, px
MOVING = 0.2  # least motion of a moving surface between two times, px
NEAR = 0.75  # distance of a picture from its time, spacings of the observed times
BESIDE = 1.5  # distance of the previous and the next picture, likewise


@dataclass(frozen=True)
class Found:
    """Result of an adjustment.

    Attributes:
        changes: Changes of the poses [R, 6], and of the clocks [R] if they are wrong, by part.
        final: True if the poses have changed so little that the depth of the scene was good enough.
    """

    changes: Mapping[str, np.ndarray]
    final: bool


def adjust(trainer: Trainer, points: np.ndarray) -> Found | None:
    """Adjust the cameras of a run.

    Args:
        trainer: The run.
        points: Points of the scene, for the units of the poses. [N, 3]

    Returns:
        The changes; None if the cameras move, are too many or share too little of the scene, or if two halves of the
        patches do not agree on the poses.
    """
    refinement, config = trainer.refinement, trainer.config
    rig, step = refinement.rig, spacing(trainer.times)
    if rig.poses != rig.lenses or rig.poses > MOST_POSES:
        return None
    problem = _problem(trainer, points, carried=False)

    def size(part: str, first: np.ndarray, second: np.ndarray) -> float:
        return agreement.agreed(part, rig.cameras, first, second, points, step)

    parts = [POSES]
    found = None
    if config.needs.time_offsets != "off" and len(trainer.times) > 3:
        found = patch_adjustment.adjust(*problem, clocks=True)
        late = 0.0 if found is None else size(CLOCKS, *found.halves)
        if late > config.refine.intervals:
            parts.append(CLOCKS)
            refinement.learn({CLOCKS: (late, math.nan)})
    if len(parts) == 1:
        found = patch_adjustment.adjust(*problem, clocks=False)
    if found is None or size(POSES, *found.halves) <= config.refine.pixels:
        return None
    changes = {POSES: found.changes[:, POSE], CLOCKS: found.changes[:, TIME.start]}
    moved = size(POSES, found.changes, found.changes)
    log.info("patches move the pictures by %.2g px; adjusted: %s", moved, ", ".join(parts))
    return Found({part: changes[part] for part in parts}, moved <= FAR)


def adjust_clocks(trainer: Trainer, points: np.ndarray) -> np.ndarray | None:
    """Adjust the clocks of a run whose poses have been adjusted, once the motion of its scene is known.

    The motion carries the patches between the times of two pictures, so that fast surfaces count, too. Poses are
    unknowns of the equations, but keep their values.

    Args:
        trainer: The run.
        points: Points of the scene, for the units of the poses. [N, 3]

    Returns:
        The changes [R]; None if two halves of the patches do not agree that the given clocks are wrong.
    """
    rig, step = trainer.refinement.rig, spacing(trainer.times)
    found = patch_adjustment.adjust(*_problem(trainer, points, carried=True), clocks=True)
    least = trainer.config.refine.intervals
    if found is None or agreement.agreed(CLOCKS, rig.cameras, *found.halves, points, step) <= least:
        return None
    changes = found.changes[:, TIME.start]
    log.info("moving patches change the clocks by up to %.2g intervals", np.abs(changes).max() / step)
    return changes


def _problem(trainer: Trainer, points: np.ndarray, *, carried: bool) -> tuple[list[DepthView], Cameras, Patches]:
    """Return the pictures, cameras and patches of an adjustment; ``carried`` if the motion of the scene is known."""
    refinement, factor = trainer.refinement, MANY if carried else 1
    depth_views = _depth_views(trainer, factor * MOMENTS, carried)
    corrections = [refinement.correction(row) for row in range(refinement.rig.poses)]
    units = np.stack([gauge.pixel_units(camera, points) for camera in refinement.rig.cameras])
    cameras = Cameras(refinement.rig.cameras, corrections, units, spacing(trainer.times))
    each = max(1, factor * PATCHES // max(1, len(depth_views)))
    return depth_views, cameras, patches.find(depth_views, cameras.corrected(), each)


def _depth_views(trainer: Trainer, moments: int, carried: bool) -> list[DepthView]:
    """Return pictures of all cameras at some times, with the velocity of the scene if ``carried``."""
    rig, step = trainer.refinement.rig, spacing(trainer.times)
    series = []
    for row in range(rig.poses):
        mine = [trainer.given_views[index] for index in np.flatnonzero(rig.pose_of == row)]
        series.append(sorted(mine, key=lambda view: view.t))
    inner = trainer.times[1:-1] if len(trainer.times) > 3 else trainer.times
    found = []
    for moment, t in enumerate(spread(list(inner), moments)):
        for row, views in enumerate(series):
            at = int(np.argmin([abs(view.t - t) for view in views]))
            if abs(views[at].t - t) <= NEAR * step:
                found.append(_depth_view(trainer, row, moment, views, at, carried))
    return found


@torch.no_grad()
def _depth_view(
    trainer: Trainer, row: int, moment: int, views: Sequence[TrainView], at: int, carried: bool
) -> DepthView:
    view, correction = views[at], trainer.refinement.correction(row)
    camera, t = correction.camera(view.camera), view.t + correction.time
    step = spacing(trainer.times)
    splats = trainer.splats(camera, t)
    velocities = torch.zeros_like(splats.means)
    if carried:
        velocities = (trainer.splats(camera, t + step).means - trainer.splats(camera, t - step).means) / (2 * step)
    drawn = rasterize_splats(splats.means, splats.quats, splats.scales, splats.opacities, velocities, camera)
    alpha, depth = to_host(drawn.alpha), to_host(drawn.depth)
    known = alpha > patches.OPAQUE
    velocity = to_host(drawn.image) / np.maximum(alpha, 1e-6)[..., None]
    moving = np.linalg.norm(velocity, axis=2) * step * camera.intrinsics[0, 0] > MOVING * depth
    velocity[~moving] = 0
    mask, left_out, opaque = view.mask, view.unexplained, view.alpha
    if mask is not None:
        known &= mask != masks.UNKNOWN
    if left_out is not None:
        known &= ~left_out
    if opaque is not None:
        known &= opaque > 127
    beside = [view, view]
    if 0 < at < len(views) - 1 and views[at + 1].t - views[at - 1].t <= 2 * BESIDE * step:
        beside = [views[at - 1], views[at + 1]]
    images = [correction.unseen(one.image / np.float32(255)) for one in (beside[0], view, beside[1])]
    span = beside[1].t - beside[0].t
    return patches.depth_view(row, moment, view.t, images, span, depth, velocity, known)

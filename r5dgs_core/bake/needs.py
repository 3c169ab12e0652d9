"""The needs table: features that a scene needs, each with its measured value, threshold and decision.

``needs.NAME`` in the configuration is the user's override of a row; it takes precedence over the measurement in
training (`training_needs.resolve`) and in baking (`decide`, `simplify_motion`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from ..config.config import Config
from ..config.sections.needs import NeedsSection
from ..data import unexplained
from ..motion import rotations
from ..scene.scene import Classifier, MotionGroup
from ..train import checkpoint_content
from ..train.observed_motion import RegroupCounts
from . import camera_needs
from .draft import Context, Draft, Need

STILL_QUAT = rotations.identity()
STILL = 0.0025  # displacement in diameters of the group below which it is at rest, if the images are missing
TURN = 0.002  # rotation in radians that is negligible, if the images are missing
SHADING_LEVEL = 0.5 / 255  # change of colour that is invisible in an 8-bit image
SKY_BAND = 0.5 / 255  # sky coefficient that is invisible in an 8-bit image


def _travel(poses: np.ndarray, radius: float) -> float:
    """Return the largest displacement of a track, in diameters."""
    return float(np.linalg.norm(poses[:, 4:], axis=1).max()) / (2 * radius)


def _turn(poses: np.ndarray) -> float:
    """Return the largest rotation of a track, rad."""
    return float(rotations.angle_between(poses[:, :4], STILL_QUAT).max())


def apply(draft: Draft, context: Context) -> Draft:
    """Write the needs table, drop unneeded shading, and add the identities if they are needed."""
    cloud, scene = draft.bound.cloud, draft.scene
    table = decide(
        scene.groups,
        scene.tracks.poses,
        motion_ids=cloud.motion_ids,
        shading=cloud.shading,
        light=draft.observed.light,
        sky_bases=len(scene.background_sh),
        bases=cloud.sh.shape[1],
        classified=cloud.identities is not None,
        residuals=draft.bent,
        moves=draft.observed.motion.moves,
        wanted=context.wanted,
    )
    on = {need.name: need.on for need in table}
    cameras = camera_needs.rows(context.cameras(scene.gaussians.means), context.config)
    rows = (*table, *cameras, left_out(context.tensors, context.config))
    scene = dataclasses.replace(scene, needs=(*(need.row() for need in rows), *draft.parts))
    if not on["shading"]:
        scene = dataclasses.replace(scene, shading=None)
    if cloud.identities is not None and on["classifier"]:
        weight, bias = (context.tensors[f"classifier.{name}"].numpy() for name in ("weight", "bias"))
        scene = scene.with_arrays(identities=cloud.identities[draft.order].astype(np.float16))
        scene = dataclasses.replace(scene, classifier=Classifier(weight, bias))
    return dataclasses.replace(draft, scene=scene)


def decide(
    groups: Sequence[MotionGroup],
    track_poses: Sequence[np.ndarray] | np.ndarray,
    *,
    motion_ids: np.ndarray,
    shading: np.ndarray,
    light: np.ndarray,
    sky_bases: int,
    bases: int,
    classified: bool,
    residuals: Need,
    moves: RegroupCounts | None = None,
    wanted: NeedsSection | None = None,
) -> tuple[Need, ...]:
    """Return the needs table of a baked scene.

    Args:
        groups: Motion groups.
        track_poses: Their tracks relative to the bind state, already simplified. G of [S, 7]
        motion_ids: Group of each Gaussian. [N]
        shading: Shading vectors in the bind state. [N, 3]
        light: Light direction. [3]
        sky_bases: Spherical harmonics bases of the sky that were kept.
        bases: Spherical harmonics bases of the colours.
        classified: True if identities and their classifier were trained.
        residuals: The row "residuals".
        moves: Gaussians that were moved to another group; None if regrouping did not run.
        wanted: User's override of each row; None measures all.

    Returns:
        The rows. The reason names the user's overrides. A feature that the run has not learned stays off.
    """
    wanted = wanted or NeedsSection()
    bodies = [g for g in groups if g.role == "body"]
    largest_travel = max((_travel(track_poses[g.id], g.model.radius) for g in bodies), default=0.0)
    largest_turn = max((_turn(track_poses[g.id]) for g in bodies), default=0.0)
    moving = sum(bool(np.any(track_poses[g.id][:, 1:] != 0)) for g in bodies)
    change = float(np.abs(shading[motion_ids > 0]).max(initial=0.0) * np.linalg.norm(light) * largest_turn)
    shadow_members = int(sum((motion_ids == g.id).sum() for g in groups if g.role == "shadow"))
    moved_over = 0 if moves is None else moves.moved
    lit = bool(np.any(shading) and np.any(light))
    moved, turned = f"{moving} of {len(bodies)} objects move or turn", "largest turn in the observed time, rad"
    followers = "Gaussians that follow a caster on its support"
    view_bases, sky = bases > 1, sky_bases > 1
    rows = (
        Need("tracks", largest_travel, 0.0, moving > 0, moved, bool(bodies)),
        Need("rotation", largest_turn, 0.0, largest_turn > 0, turned, bool(bodies)),
        Need("shading", change, SHADING_LEVEL, change > SHADING_LEVEL, "largest change of colour", lit),
        Need("shadows", shadow_members, 1, shadow_members > 0, followers, shadow_members > 0),
        Need("view_dependent_colour", bases, 2, view_bases, "spherical harmonics bases", view_bases),
        Need("sky_gradient", sky_bases, 2, sky, "spherical harmonics bases of the sky", sky),
        Need("classifier", len(bodies), 1, classified, "objects with masks", classified),
        residuals,
        Need("regrouping", moved_over, 1, moved_over > 0, _summary(moves), moved_over > 0),
    )
    return tuple(need.overridden(getattr(wanted, need.name)) for need in rows)


def left_out(tensors: Mapping[str, Tensor], config: Config) -> Need:
    """Return the row for regions that move although no mask names them, which training has decided.

    Args:
        tensors: Tensors of a checkpoint.
        config: The run's configuration.
    """
    found = tensors.get(checkpoint_content.UNEXPLAINED)
    share, on = (0.0, False) if found is None else (float(found[0]), bool(found[1]))
    reason = "not examined" if found is None else "share of the pixels that move although no mask names them"
    need = Need(unexplained.NEED, share, config.init.unexplained, on, reason, on)
    return need.decided_by_training(config.needs.unexplained_regions)


def _summary(moves: RegroupCounts | None) -> str:
    """Summary of the regrouping, for the reason of its row."""
    if moves is None:
        return "each Gaussian moves with its initial group"
    text = (
        f"of {moves.moving} Gaussians that move, {moves.to_bodies} went to another body, {moves.to_shadows} to a "
        f"shadow, {moves.to_rest} to rest"
    )
    return text + (f"; {moves.resting_shadows} shadows rest" if moves.resting_shadows else "")

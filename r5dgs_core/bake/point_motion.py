"""Motion of single Gaussians as stored in a scene: residuals relative to the rigid motion of their groups.

Notation: R Gaussians with states x_s at the knots s, last knot T. Their group moves the bind state x_T to Q_s (x_T - p)
+ p + D_s. A residual is the change of the bind state that the group's motion maps to x_s.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from ..config.config import Config
from ..motion import rotations
from ..scene.scene import Dynamics, MotionGroup, Residuals
from ..train.normalization import Normalization
from ..train.observed_motion import PointMotion
from ..train.representations import registry
from .draft import Context, Draft, Need

BLOCK = 8192  # Gaussians per block, which bounds memory
# minimum residual to store: offset / longest side of the scene's box, angle in rad, or change of log scale
VISIBLE = 1e-4


def apply(draft: Draft, context: Context) -> Draft:
    """Add the motion of single Gaussians to the scene, with the measurement of its need."""
    scene, bound, points = draft.scene, draft.bound, draft.observed.motion.points
    bends, own = None, None
    if points is not None and context.wanted.tracks != "off":
        extent = float(np.ptp(np.quantile(bound.cloud.means, [0.01, 0.99], axis=0), axis=0).max())
        # Relative to the trained poses, so that motion that the user switched off does not return as residuals.
        bends, own = residuals_and_dynamics(
            points, context.norm, bound.cloud.motion_ids, bound.trained, bound.pivots, draft.order, extent
        )
    bent = draft.bent
    if registry.by_name(context.state.representation).moves:
        bodies = Counter(group.object_id for group in draft.observed.motion.groups if group.role == "body")
        names = context.dataset.object_names
        bent = residual_need(context.tensors, names, bodies, context.config, bends is not None)
    if not bent.on or context.wanted.residuals == "off":
        bends = None
    groups = scene.groups if bends is None else with_rigid_errors(scene.groups, scene.gaussians.motion_ids, bends)
    scene = dataclasses.replace(scene, groups=tuple(groups), residuals=bends, dynamics=own)
    return dataclasses.replace(draft, scene=scene, bent=bent)


def residuals_and_dynamics(
    points: PointMotion,
    norm: Normalization,
    motion_ids: np.ndarray,
    track_poses: np.ndarray,
    pivots: np.ndarray,
    order: np.ndarray,
    extent: float,
) -> tuple[Residuals | None, Dynamics | None]:
    """Return the motion of single Gaussians, each part None if the scene does not need it.

    Args:
        points: States at the knots, training coordinates.
        norm: Training coordinates to world coordinates.
        motion_ids: Group of each Gaussian, in the order of training. [N]
        track_poses: Poses of the groups at the knots, relative to the bind state. [G, S, 7]
        pivots: Pivots of the groups, world. [G, 3]
        order: Training row of each row of the scene. [N]
        extent: Longest side of the scene's box, world units.
    """
    dynamics = None
    if points.dynamics is not None and np.any(points.dynamics):
        linear = np.repeat([norm.scale, 1.0, norm.scale, 1.0], 3)
        canonical = points.canonical
        dynamics = Dynamics(
            rates=(points.dynamics * linear)[order].astype(np.float32),
            canonical_means=None if canonical is None else norm.points_to_world(canonical)[order].astype(np.float32),
        )
    rank = np.argsort(order)[points.rows]
    parts = []
    for chosen in np.array_split(np.argsort(rank), max(1, -(-len(rank) // BLOCK))):  # in the scene's order
        ids = motion_ids[points.rows[chosen]]
        offsets, turns, growths = _relative(points, chosen, norm, track_poses[ids], pivots[ids])
        seen = np.abs(offsets).max((1, 2), initial=0.0) > VISIBLE * extent
        seen |= np.abs(growths).max((1, 2), initial=0.0) > VISIBLE
        seen |= rotations.angle_between(turns, turns[:, -1:]).max(1, initial=0.0) > VISIBLE
        stored = (offsets[seen], turns[seen], growths[seen])
        parts.append((rank[chosen[seen]].astype(np.int32), *(part.astype(np.float32) for part in stored)))
    residuals = Residuals(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return residuals if len(residuals.rows) else None, dynamics


def _relative(
    points: PointMotion, chosen: np.ndarray, norm: Normalization, poses: np.ndarray, pivots: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals: offsets [R, S, 3], rotations with continuous signs [R, S, 4], changes of log scales [R, S, 3].

    Args:
        points: States at the knots, training coordinates.
        chosen: Rows of ``points``. [R]
        norm: Training coordinates to world coordinates.
        poses: Poses of the rows' groups, relative to the bind state. [R, S, 7]
        pivots: Pivots of the rows' groups, world. [R, 3]
    """
    pivot, world = pivots[:, None], norm.points_to_world(points.means[chosen])
    back = rotations.conjugate(poses[..., :4])
    offsets = pivot + rotations.rotate(back, world - pivot - poses[..., 4:]) - world[:, -1:]
    quats = points.quats[chosen]
    turns = rotations.normalize(rotations.multiply(rotations.multiply(back, quats), rotations.conjugate(quats[:, -1:])))
    growths = points.log_scales[chosen] - points.log_scales[chosen][:, -1:]
    offsets[:, -1], growths[:, -1], turns[:, -1] = 0.0, 0.0, [1.0, 0, 0, 0]
    backwards = np.moveaxis(turns[:, ::-1], 1, 0)  # signs are continuous from the last knot, the identity
    return offsets, np.moveaxis(rotations.make_continuous(backwards), 0, 1)[:, ::-1], growths


def with_rigid_errors(groups: Sequence[MotionGroup], motion_ids: np.ndarray, residuals: Residuals) -> list[MotionGroup]:
    """Return the groups with the deviations of their members from rigid motion in the observed time (rms and maximum).

    Args:
        groups: Motion groups.
        motion_ids: Group of each Gaussian of the scene. [N]
        residuals: Residuals of some of them.
    """
    squares, result = (residuals.offsets.astype(np.float64) ** 2).sum(-1), []
    for group in groups:
        mine = squares[motion_ids[residuals.rows] == group.id]
        count = max(1, int((motion_ids == group.id).sum()) * squares.shape[1])
        rms, largest = float(np.sqrt(mine.sum() / count)), float(np.sqrt(mine.max(initial=0.0)))
        result.append(dataclasses.replace(group, rigid_rms=rms, rigid_max=largest))
    return result


def residual_need(
    tensors: Mapping[str, Tensor], names: Mapping[int, str], bodies: Mapping[int, int], config: Config, there: bool
) -> Need:
    """Return the row "residuals" of the needs table; its value is the largest gain, dB.

    Args:
        tensors: Tensors of the checkpoint.
        names: Names of the objects by id.
        bodies: Number of bodies by object id.
        config: The run's configuration.
        there: True if the scene has residuals.
    """
    from ..train.representations import residual  # static scenes do not need it

    threshold, field = config.residual.threshold, residual.residual_of(tensors)
    if residual.GAINS not in tensors:
        reason = "every Gaussian moves by the deformation field" if there else "gain by bending, dB; none was tried"
        return Need("residuals", 0.0, threshold, there, reason, there)
    gains, ids = tensors[residual.GAINS].numpy(), tensors["object_ids"].numpy()
    kept = [] if field is None else field.bodies
    largest = float(np.nanmax(gains)) if np.isfinite(gains).any() else 0.0
    labels = {int(i): names.get(int(i), f"object {i}") for i in ids}
    divided = [i for i in labels if bodies.get(i, 1) > 1]
    bent = ", ".join(f"{labels[int(ids[b])]} ({gains[b - 1]:+.1f})" for b in kept)
    parts = ", ".join(f"{labels[i]} ({bodies[i]})" for i in divided)
    rigid = f"{len(gains) - len(kept) - len(divided)} of {len(gains)} objects are rigid"
    if kept and not there and config.needs.residuals != "off":
        bent += ", too little to be stored"
    found = (bent, f"divided into parts: {parts}" if parts else "", rigid)
    reason = "gain by bending, dB: " + "; ".join(text for text in found if text)
    return Need("residuals", largest, threshold, there, reason, there)

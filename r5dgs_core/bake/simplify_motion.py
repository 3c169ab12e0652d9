"""Simplification of the motion of a scene's bodies: rotations, paths and bends that are noise are dropped.

The motion of a body has two parts, rotation and path. The rotation may be dropped, and the path may be replaced by a
fixed place or a straight line. Each simplification is applied if and only if

- the poses do not change by more than their noise: the training images do not distinguish the simpler motion from the
  trained one (`image_evidence`), by an F test at `LEVEL`; or the pixels of the body change by less than half a level of
  8 bits; or a rotation mainly changes colours, not shape (`SHAPE`); and
- all simplifications of the scene together lower the PSNR of the training views by at most `LOSS`.

A part that only improves colours, such as a rotation by which shading imitates a shadow, is kept in the observed time,
but the motion past t_max is fitted without it.

Notation: G groups, S poses. Until `bind_state.rebind`, poses are relative to the bind state of the given scene.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from ..config.sections.needs import NeedsSection
from ..motion import rotations, se3
from ..motion_fit import model_selection, shared_gravity
from ..scene.scene import MotionGroup, Scene
from . import bind_state, future_fit, image_evidence, needs, pose_errors, track_checks, unseen_rotations
from .draft import Context, Draft, Need
from .image_evidence import ImageEvidence
from .unseen_rotations import Unseen

LEVEL = 0.01  # significance level: probability of taking noise for motion
LOSS = 0.03  # maximum loss of PSNR on the training views by all simplifications together, dB
SHAPE = 0.5  # share of shape in a rotation's effect on the images, below which it only fits colours (passing shadows)
CLEARLY = 3.0  # change / allowed change above which one view per cluster decides
LARGEST = 0.05  # spread (rad or diameters) above which motion is kept without comparing images
_SPREADS = {
    "rotation": "spread of its rotations, rad",
    "motion": "spread of its places, diameters",
    "curved_path": "distance from a straight path, diameters",
}


@dataclass(frozen=True)
class _Kind:
    """Part of a body's motion that can be simplified.

    Attributes:
        name: Row of the needs table that it decides.
        columns: Its columns of the poses.
        offset: Parameter of motion models that moves the fitted motion to the last pose.
        meaning: Meaning of the spread, in words.
    """

    name: str
    columns: slice
    offset: str
    meaning: str

    @property
    def turns(self) -> bool:
        """True if it is measured in rad, not in world units."""
        return self.columns == _TURN


_TURN, _PATH = slice(0, 4), slice(4, 7)  # columns of poses
_ROTATION = _Kind("rotation", _TURN, "offset_rotvec", "spread of its rotations, rad")  # simplified to no rotation
# simplified to one fixed place, and to a straight line
_PLACE = _Kind("motion", _PATH, "offset_displacement", "spread of its places, diameters")
_BEND = _Kind("curved_path", _PATH, "offset_displacement", "distance from a straight path, diameters")


@dataclass(frozen=True)
class _Simplification:
    """Simplification of one body's motion.

    Attributes:
        group: Group of the body.
        kind: The part of the motion that is simplified.
        poses: Simplified poses of the body. [S, 7]
        spread: Root mean square per component of the dropped motion, rad or world units.
        value: Spread in rad or diameters.
        change: Spread in units of its noise.
        allowed: Maximum change that counts as noise.
        why: Basis of the noise estimate, in words.
        kept: True if the user keeps the part.
        seen: True if the noise was measured in the images.
    """

    group: int
    kind: _Kind
    poses: np.ndarray
    spread: float
    value: float
    change: float
    allowed: float
    why: str
    kept: bool
    seen: bool

    @property
    def is_noise(self) -> bool:
        """True if the poses change by no more than their noise."""
        return self.change <= self.allowed and not self.kept


@dataclass(frozen=True)
class Simplified:
    """Scene with simplified motion.

    Attributes:
        scene: The scene, in a new bind state for bodies whose last pose was not on the simplified motion.
        rows: Measurements and decisions for each body, as rows of the needs table.
        slipped: See `Draft`.
    """

    scene: Scene
    rows: tuple[dict[str, Any], ...]
    slipped: Mapping[int, Sequence[tuple[float, float]]]


def apply(draft: Draft, context: Context) -> Draft:
    """Simplify the motion of the scene by the evidence of the training images."""
    observed = np.stack([group.observed for group in draft.observed.motion.groups])
    evidence = image_evidence.gather(draft.scene, context)
    measured = pose_errors.NOTHING
    if evidence is not None:
        masked, ids = not context.discovered, [group.id for group in _moving(draft.scene)]
        measured = pose_errors.measure(draft.scene, context.dataset, context.config, ids, masked, context.explained)
    found = simplify(draft.scene, observed, evidence, context.wanted, measured)
    return dataclasses.replace(draft, scene=found.scene, trained=draft.scene, parts=found.rows, slipped=found.slipped)


def simplify(
    scene: Scene,
    observed: np.ndarray,
    evidence: ImageEvidence | None,
    wanted: NeedsSection | None = None,
    measured: pose_errors.Measured = pose_errors.NOTHING,
) -> Simplified:
    """Drop rotations, paths and bends that are noise, and fit the motion past t_max.

    Args:
        scene: The scene with trained poses and static models that hold the groups' radii.
        observed: Knots at which each group was placed. [G, S] bool
        evidence: The training images; None if they are missing. Then only motion below `needs.STILL` and `needs.TURN`
            is dropped.
        wanted: The user's overrides; parts that are "on" are kept.
        measured: Errors of the observed poses of groups, and rotations that are not seen.

    Returns:
        The simplified scene. Groups that follow a body follow its simplified motion.
    """
    wanted = wanted or NeedsSection()
    unseen = {} if wanted.rotation == "on" else measured.unseen
    names = {item.id: item.name for item in scene.objects}
    bodies = _moving(scene)
    parts = [part for g in bodies for part in _parts(scene, g.id, observed[g.id], evidence, wanted)]
    dropped, losses = _affordable(scene, [part for part in parts if part.is_noise], evidence)
    bound = bind_state.rebind(scene, _with_parts(scene, dropped))
    rows: list[dict[str, Any]] = []
    fits: dict[int, tuple[shared_gravity.BodyTrack, model_selection.Fit]] = {}
    for g in bodies:
        mine = [part for part in parts if part.group == g.id]
        future = _future(bound.tracks.poses[g.id], mine)
        if g.id in unseen:
            future = _without_spin(bound, g.id, future, unseen[g.id])
        if np.any(future[:, 1:] != 0):
            track_checks.warn_of_aliasing(names[g.object_id], scene.tracks.times, future)
            fits[g.id] = future_fit.fit(bound, g.id, observed[g.id], future, _noise(mine), measured.errors.get(g.id))
            track_checks.warn_of_slips(names[g.object_id], fits[g.id][1].slips)
        description = future_fit.describe(fits[g.id][1] if g.id in fits else None)
        travel = float(np.linalg.norm(bound.tracks.poses[g.id, :, 4:], axis=1).max()) / (2 * g.model.radius)
        found = [_row(part, part in dropped, losses.get(id(part)), description, travel) for part in mine]
        found += [_unseen_row(unseen[g.id])] if g.id in unseen else []
        rows += [{"object": names[g.object_id], **row} for row in found]
    shared = future_fit.share_gravity(fits, scene.world_convention)
    models, groups = {index: fit.model for index, fit in shared.items()}, list(bound.groups)
    for part in parts:  # a model fitted without noise starts at the bind state
        if part.is_noise and part.group in models:
            models[part.group] = dataclasses.replace(models[part.group], **{part.kind.offset: np.zeros(3)})
    for index, model in models.items():
        history = shared[index].history
        if index in unseen and history.errors is not None:
            history = dataclasses.replace(history, errors=pose_errors.with_unseen(history.errors, unseen[index]))
        groups[index] = dataclasses.replace(groups[index], model=model, history=history)
    slipped = {index: fit.slipped for index, fit in shared.items() if fit.slipped}
    groups = future_fit.with_unknown_motion(groups, observed, scene.tracks.times, shared)
    return Simplified(dataclasses.replace(bound, groups=groups), tuple(rows), slipped)


def _moving(scene: Scene) -> list[MotionGroup]:
    """Return the bodies whose track moves."""
    return [g for g in scene.groups if g.role == "body" and np.any(scene.tracks.poses[g.id, :, 1:] != 0)]


def _parts(
    scene: Scene, group: int, observed: np.ndarray, evidence: ImageEvidence | None, wanted: NeedsSection
) -> list[_Simplification]:
    """Return the candidate simplifications of a body: no rotation, a fixed place and, if it moves, a straight path."""
    poses, weights = scene.tracks.poses[group], observed.astype(np.float64)
    weights = weights if weights.any() else np.ones(len(poses))
    mean = rotations.normalize(weights @ rotations.make_continuous(poses[:, :4]))
    upright = poses.copy()
    upright[:, :4] = mean
    turns = rotations.quats_to_rotvecs(rotations.multiply(poses[:, :4], rotations.conjugate(mean)))
    result = [_measured(scene, group, _ROTATION, upright, turns, weights, evidence, wanted.rotation == "on")]
    tau = scene.tracks.times - scene.tracks.times[-1]
    for kind, degree in ((_PLACE, 0), (_BEND, 1)):
        columns = tau[:, None] ** np.arange(degree + 1)
        root = np.sqrt(weights)[:, None]
        plain = poses.copy()
        plain[:, 4:] = columns @ np.linalg.lstsq(columns * root, poses[:, 4:] * root, rcond=None)[0]
        dropped = poses[:, 4:] - plain[:, 4:]
        result.append(_measured(scene, group, kind, plain, dropped, weights, evidence, wanted.tracks == "on"))
        if result[-1].is_noise:
            break
    return result


def _measured(
    scene: Scene,
    group: int,
    kind: _Kind,
    poses: np.ndarray,
    dropped: np.ndarray,
    weights: np.ndarray,
    evidence: ImageEvidence | None,
    kept: bool,
) -> _Simplification:
    """Return a candidate whose dropped motion [S, 3] (rad or world units) is measured in units of its noise."""
    unit = 1.0 if kind.turns else 2 * scene.groups[group].model.radius
    spread = float(np.sqrt(np.average((dropped**2).mean(1), weights=weights)))
    if evidence is None:
        limit = needs.TURN if kind.turns else needs.STILL
        change, allowed, seen = float(np.linalg.norm(dropped, axis=1).max()) / unit / limit, 1.0, False
        why = "the images are missing"
    elif spread > LARGEST * unit:
        change, allowed, seen, why = spread / unit / LARGEST, 1.0, False, "too large for noise"
    else:
        after = scene.tracks.poses.copy()
        after[group] = poses
        largest = 2 * float(np.linalg.norm(dropped, axis=1).max()) / (2.0 if kind.turns else unit)
        free, seen, drawn = 3 * _independent(dropped[weights > 0]), True, {}
        for rows in (evidence.strongest_views(np.linalg.norm(dropped, axis=1)), None):
            support = evidence.support(group, scene.tracks.poses, _move_followers(scene, after), largest, rows, drawn)
            change = max(support.sigmas, 0.0) / np.sqrt(free)
            allowed = float(np.sqrt(special.fdtri(free, max(support.clusters - 1, 1), 1 - LEVEL)))
            if change > CLEARLY * allowed:
                break
        why = f"{change:.2g} times its noise, at most {allowed:.2g} is noise"
        if support.level <= needs.SHADING_LEVEL:
            allowed, why = max(allowed, change), f"the images do not show it ({255 * support.level:.2g} levels of 255)"
        elif support.shape < SHAPE:
            allowed, why = max(allowed, change), f"it only fits colours (shape is {support.shape:.0%} of its effect)"
    return _Simplification(group, kind, poses, spread, spread / unit, float(change), allowed, why, kept, seen)


def _independent(series: np.ndarray) -> float:
    """Return the number of independent values in an autocorrelated series, from its first lag. [S, 3]"""
    energy = float((series**2).sum())
    lag = float((series[1:] * series[:-1]).sum()) / energy if energy > 0 else 0.0
    lag = min(max(lag, 0.0), 1.0)
    return max(1.0, len(series) * (1 - lag) / (1 + lag))


def _affordable(
    scene: Scene, parts: Sequence[_Simplification], evidence: ImageEvidence | None
) -> tuple[list[_Simplification], dict[int, float]]:
    """Return the parts that can be dropped within `LOSS`, cheapest first, and the PSNR loss of each by its `id`, dB."""
    if evidence is None or not parts:
        return list(parts), {}
    losses = {id(part): evidence.loss(_with_parts(scene, [part])) for part in parts}
    chosen, total = [], 0.0
    for part in sorted(parts, key=lambda part: losses[id(part)]):
        total += losses[id(part)]
        if total > LOSS:
            break
        chosen.append(part)
    while len(chosen) > 1 and evidence.loss(_with_parts(scene, chosen)) > LOSS:
        chosen.pop()
    return chosen, losses


def _with_parts(scene: Scene, parts: Sequence[_Simplification]) -> np.ndarray:
    """Return the poses of all groups with some simplifications applied. [G, S, 7]"""
    poses = scene.tracks.poses.copy()
    for part in parts:
        poses[part.group, :, part.kind.columns] = part.poses[:, part.kind.columns]
    return _move_followers(scene, poses)


def _move_followers(scene: Scene, poses: np.ndarray) -> np.ndarray:
    """Update the poses of followers to the new poses of their leaders, in place, and return the poses. [G, S, 7]"""
    change = poses[..., 4:] - scene.tracks.poses[..., 4:]
    for g in scene.groups:
        if g.follows is not None and g.follow_matrix is not None:
            poses[g.id, :, 4:] = scene.tracks.poses[g.id, :, 4:] + change[g.follows] @ g.follow_matrix.T
    return poses


def _future(poses: np.ndarray, parts: Sequence[_Simplification]) -> np.ndarray:
    """Return the poses for the fit past t_max, relative to t_max.

    Parts that count as noise are left out, even those kept up to t_max. [S, 7]
    """
    result = poses.copy()
    for part in parts:
        if part.is_noise and part.kind.turns:
            result[:, :4] = rotations.identity()
        elif part.is_noise:
            result[:, 4:] = part.poses[:, 4:] - part.poses[-1, 4:]
    return result


def _without_spin(scene: Scene, group: int, poses: np.ndarray, unseen: Unseen) -> np.ndarray:
    """Return the poses of a body without rotation about its unseen axes. [S, 7]"""
    center = np.median(scene.gaussians.means[scene.gaussians.motion_ids == group].astype(np.float64), axis=0)
    return se3.without_spin(poses, unseen.axes, center - scene.groups[group].pivot)


def _unseen_row(unseen: Unseen) -> dict[str, Any]:
    """Row of the needs table for rotations that are not predicted because no image shows them."""
    text = f"{unseen.text()}; share of the contrast that shade does not explain"
    return Need("unseen_rotation", unseen.texture, unseen_rotations.TEXTURE, False, text).row()


def _noise(parts: Sequence[_Simplification]) -> tuple[float, float]:
    """Return the noise of displacements and rotations that was measured in the images, 0 if it was not."""
    found = {part.kind.turns: part.spread / part.change for part in parts if part.seen and part.change > 0}
    return found.get(False, 0.0), found.get(True, 0.0)


def _row(part: _Simplification, dropped: bool, loss: float | None, future: str, travel: float) -> dict[str, Any]:
    """Row of the needs table for a part; its threshold is the maximum spread that counts as noise."""
    threshold = part.value * part.allowed / part.change if part.change > 0 else LARGEST
    why = part.why
    if loss is not None:
        why += f"; without it the training views lose {loss:.3f} dB"
        why += "" if dropped else f", more than what remains of the allowed {LOSS:g} dB, so it is kept up to t_max"
    if part.kept:
        why = f"set on by the user; {why}"
    text = f"{part.kind.meaning}: {why}"
    if part.kind == _PLACE:
        text += f"; goes {travel:.3g} diameters; past t_max: {future}"
    return Need(part.kind.name, part.value, threshold, not dropped, text).row()

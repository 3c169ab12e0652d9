"""Conversion of a trained field for baking: states of its Gaussians at the knots, fitted group motions, dynamics.

Notation: N Gaussians, R of them moved, S knots up to the horizon T, B classes (0 the background). Bind state: at T. The
motion of a group is the robust Kabsch fit of its members' centres from T to each knot.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...motion import rigid_fit, rotations, se3
from ...motion_fit import backtest
from ...scene import spherical_harmonics
from ...scene.splats import to_opacities
from ..observed_motion import GroupTrack, ObservedMotion, PointMotion
from . import regrouping as regroup
from . import shading
from .field_motion import FieldMotion

SHADOW_RIDGE = 0.05  # ridge weight of the projection in the fit of a shadow's map / mean square of the caster's motion


def knots(times: np.ndarray, horizon: float) -> np.ndarray:
    """Return the times at which the field is sampled: the observed ones before the horizon, and the horizon. [S]"""
    before = times[times < horizon - 1e-9 * max(1.0, abs(horizon))]
    return np.concatenate([before, [horizon]])


@torch.no_grad()
def observed_motion(
    motion: FieldMotion,
    gaussians: dict[str, Tensor],
    movers: Tensor,
    labels: np.ndarray,
    object_ids: np.ndarray,
    alone: int,
    seen: np.ndarray,
    times: np.ndarray,
    shadows: Sequence[int],
    normal: np.ndarray,
    light: np.ndarray,
    regrouping: str = "auto",
) -> ObservedMotion:
    """Sample a field at the knots and fit its groups.

    Args:
        motion: Field and TRD.
        gaussians: Canonical parameters by name.
        movers: Rows that the networks move. [R]
        labels: Class of each Gaussian. [N]
        object_ids: Object id of each class. [B]
        alone: Motion id of movers that belong to no group.
        seen: Knots of the training at which each object was located by its masks. [B - 1, K] bool
        times: These knots. [K]
        shadows: Caster (a class) of each group from B on.
        normal: Normal of the plane that carries shadows. [3]
        light: Light of the shading. [3]
        regrouping: "off" leaves Gaussians in their original groups.
    """
    at, rows = knots(times, motion.horizon), movers.numpy()
    points, since = _sample(motion, gaussians, movers, at)
    path = points.means
    bind = _bind_state(gaussians, points, since, light)
    motion_ids = _motion_ids(gaussians["motion_ids"].numpy()[rows], labels, rows, alone)
    own, opacities = motion_ids[rows], to_opacities(gaussians["opacity_logits"].numpy()[rows])
    nearest = np.abs(times[None] - at[:, None]).argmin(1)
    observed = np.concatenate([np.ones((1, len(times)), bool), seen])[:, nearest]
    observed[:, -1] = True

    def fit(ids: np.ndarray) -> list[GroupTrack]:
        return _groups(path, ids, opacities, object_ids, observed, shadows, normal)

    groups, moves = fit(own), None
    if regrouping != "off":
        original_ids = own
        own, groups, moves = regroup.regroup_until_stable(path, own, opacities, fit)
        if len(shadows) == 0:  # without shadow groups, background Gaussians may imitate shadows
            casters = regroup.imitators(path, own, opacities, groups, normal)
            shadows = np.unique(casters[casters > 0]).tolist()
            if shadows:
                own = np.where(casters > 0, len(object_ids) + np.searchsorted(shadows, casters), own)
                own, groups, moves = regroup.regroup_until_stable(path, own, opacities, fit, original_ids)
        motion_ids[rows] = own
    return ObservedMotion(at, tuple(groups), light, bind, motion_ids, points, moves=moves)


def _sample(
    motion: FieldMotion, gaussians: dict[str, Tensor], movers: Tensor, at: np.ndarray
) -> tuple[PointMotion, np.ndarray]:
    """Return the states of the movers at the knots, and their rotations at the horizon since the canonical state.

    Returns:
        The motion, and rotations wxyz. [R, 4]
    """
    means, quats = gaussians["means"][movers], rotations.normalize(gaussians["quats"][movers])
    states = [motion.deltas(means, float(t)) for t in at]
    path = torch.stack([means + s.offsets for s in states], 1).numpy().astype(np.float64)
    turns = torch.stack([rotations.multiply(s.quats, quats) for s in states], 1).numpy().astype(np.float64)
    sizes = torch.stack([gaussians["log_scales"][movers] + s.log_scales for s in states], 1).numpy()
    state = motion.state(means + states[-1].offsets, motion.horizon)
    canonical = gaussians["means"].numpy().copy()
    dynamics = np.zeros((len(canonical), 12))
    dynamics[movers.numpy()] = _about_own_centre(path[:, -1], state, motion.clock.scale)
    points = PointMotion(movers.numpy(), path, turns, sizes.astype(np.float64), dynamics, canonical)
    return points, states[-1].quats.numpy().astype(np.float64)


def _bind_state(
    gaussians: dict[str, Tensor], points: PointMotion, since: np.ndarray, light: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the parameters of all Gaussians in the bind state, with the shading of that pose.

    Args:
        gaussians: Canonical parameters by name.
        points: Result of `_sample`.
        since: Result of `_sample`. [R, 4]
        light: Light of the shading. [3]
    """
    rows = points.rows
    bind = {name: tensor.numpy().copy() for name, tensor in gaussians.items()}
    sh = spherical_harmonics.rotate(
        np.concatenate([bind["sh"], bind["sh_rest"]], axis=1).astype(np.float64)[rows], since
    )
    ones = np.ones(len(sh))
    sh, vectors, lit = shading.rebind(sh, bind["shading"][rows].astype(np.float64), ones, since, light)
    bind["shading_rest"] = np.ones(len(bind["means"]))
    pose = {"means": points.means, "quats": points.quats, "log_scales": points.log_scales}
    moved = {"sh": sh[:, :1], "sh_rest": sh[:, 1:], "shading": vectors, "shading_rest": lit}
    for name, values in ({name: states[:, -1] for name, states in pose.items()} | moved).items():
        bind[name][rows] = values
    return bind


def _motion_ids(trained: np.ndarray, labels: np.ndarray, rows: np.ndarray, alone: int) -> np.ndarray:
    """Return the group of each Gaussian before regrouping. [N]

    Args:
        trained: Groups of the movers in training. [R]
        labels: Class of each Gaussian. [N]
        rows: The movers. [R]
        alone: Motion id of movers that belong to no group.
    """
    own = np.where(trained == alone, labels[rows], trained)
    if not own.any():  # training had no groups, so the labels define them
        own = labels[rows].astype(np.int64)
    result = np.zeros(len(labels), np.int64)
    result[rows] = own
    resting = ~np.isin(labels, own)  # objects without movers are groups, too
    resting[rows] = False  # movers stay in their groups even if the masks label them as background
    result[resting] = labels[resting]
    return result


def _groups(
    path: np.ndarray,
    ids: np.ndarray,
    opacities: np.ndarray,
    object_ids: np.ndarray,
    observed: np.ndarray,
    shadows: Sequence[int],
    normal: np.ndarray,
) -> list[GroupTrack]:
    """Fit the groups to their members: the pinned one, a body per object, the shadows.

    Args:
        path: Centres of the movers at the knots. [R, S, 3]
        ids: Groups of the movers. [R]
        opacities: [R]
        object_ids: Object id of each class. [B]
        observed: Knots at which each class was located by its masks. [B, S] bool
        shadows: Caster (a class) of each group from B on.
        normal: Normal of the plane that carries shadows. [3]
    """
    unturned, nowhere = rotations.identity(path.shape[1]), np.zeros((path.shape[1], 3))
    groups = [GroupTrack(0, "pinned", np.zeros(3), unturned, nowhere, observed[0])]
    for row in range(1, len(object_ids)):
        members = ids == row
        center, quat, shift = _track(path[members], regroup.fit_weights(path[members, -1], opacities[members]))
        groups.append(GroupTrack(int(object_ids[row]), "body", center, quat, shift, observed[row]))
    for k, caster in enumerate(shadows):
        members = ids == len(object_ids) + k
        leader, weights = groups[caster], regroup.fit_weights(path[members, -1], opacities[members])
        matrix = _follow(path[members], weights, leader.displacements, normal)
        if not follows(path[members], weights, leader.displacements, normal):
            matrix = np.zeros((3, 3))
        center = np.average(path[members, -1], axis=0, weights=weights) if members.any() else leader.center
        shift = leader.displacements @ matrix.T
        groups.append(GroupTrack(leader.object_id, "shadow", center, unturned, shift, leader.observed, caster, matrix))
    return groups


def _track(path: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre at the last knot, and rotations [S, 4] and displacements [S, 3] relative to it."""
    count = path.shape[1]
    quats, shifts = rotations.identity(count), np.zeros((count, 3))
    if len(path) == 0:
        return np.zeros(3), quats, shifts
    center = np.average(path[:, -1], axis=0, weights=weights)
    for k in range(count - 2, -1, -1):
        fit = rigid_fit.fit_rigid(path[:, -1], path[:, k], weights, hint=quats[k + 1])
        quats[k], shifts[k] = fit.quat, fit.displacement_at(center)
    return center, quats, shifts


def _follow(path: np.ndarray, weights: np.ndarray, leader: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Fit the linear map from a caster's displacements to its shadow's, regularised towards the projection. [3, 3]"""
    flat = np.eye(3) - np.outer(normal, normal)
    if len(path) == 0:
        return flat
    moved = np.average(path - path[:, -1:], axis=0, weights=weights)
    gram = leader.T @ leader
    ridge = SHADOW_RIDGE * np.trace(gram) / 3 + 1e-9
    return np.linalg.solve(gram + ridge * np.eye(3), leader.T @ moved + ridge * flat.T).T


def follows(path: np.ndarray, weights: np.ndarray, leader: np.ndarray, normal: np.ndarray) -> bool:
    """Return True if a map fitted to the earlier knots predicts a shadow's last positions no worse than no motion.

    The result is also True without enough knots or members.

    Args:
        path: Centres of the shadow's Gaussians at the knots. [n, S, 3]
        weights: Weights of these. [n]
        leader: Displacements of the caster. [S, 3]
        normal: Normal of the plane. [3]
    """
    last = len(leader) - 1 - max(2, round(backtest.HELD_OUT * len(leader)))
    if last < 2 or len(path) == 0:
        return True
    matrix = _follow(path[:, : last + 1], weights, leader[: last + 1] - leader[last], normal)
    moved = path[:, last + 1 :] - path[:, last : last + 1]
    missed = moved - (leader[last + 1 :] - leader[last]) @ matrix.T
    went, stayed = (np.average(np.linalg.norm(x, axis=-1).mean(1), weights=weights) for x in (missed, moved))
    return bool(went <= stayed)


def _about_own_centre(points: np.ndarray, state, scale: float) -> np.ndarray:
    """Return velocity, angular velocity and their rates per scene time, about each Gaussian's own centre. [R, 12]"""
    v, w, a, e = (
        x.numpy().astype(np.float64)
        for x in (
            state.equiv_velocity,
            state.angular_velocity,
            state.equiv_acceleration,
            state.angular_acceleration,
        )
    )
    v, a = se3.recentre(w, v, e, a, points)
    return np.concatenate([v / scale, w / scale, a / scale**2, e / scale**2], axis=-1)

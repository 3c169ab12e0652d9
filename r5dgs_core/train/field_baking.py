"""What a trained field hands to baking: states of its Gaussians at the knots, group motions fitted to them, dynamics.

Notation: N Gaussians, R of them moved, S knots up to the horizon T, B classes (0 the background). Bind state: at T.
The motion of a group is the robust Kabsch fit of its members' centres from T to each knot.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..model import spherical_harmonics
from ..motion import poses, rotations, se3
from . import shading
from .field_motion import Motion
from .groups import GroupTrack, ObservedMotion, PointMotion

SHADOW_RIDGE = 0.05  # pull of a shadow's map towards the projection onto the plane, as a share of the caster's motion


def knots(times: np.ndarray, horizon: float) -> np.ndarray:
    """Times at which the field is sampled: the observed ones up to the horizon, and the horizon. [S]"""
    before = times[times < horizon - 1e-9 * max(1.0, abs(horizon))]
    return np.concatenate([before, [horizon]])


@torch.no_grad()
def observed_motion(
    motion: Motion,
    gaussians: dict[str, Tensor],
    movers: Tensor,
    labels: np.ndarray,
    object_ids: np.ndarray,
    seen: np.ndarray,
    times: np.ndarray,
    shadows: Sequence[int],
    normal: np.ndarray,
    light: np.ndarray,
) -> ObservedMotion:
    """Sample a field at the knots and fit its groups.

    Args:
        motion: Field and TRD.
        gaussians: Canonical parameters by name.
        movers: Rows that the networks move. [R]
        labels: Class of each Gaussian. [N]
        object_ids: Object id of each class. [B]
        seen: Knots of the training at which each object was placed by its masks. [B - 1, K] bool
        times: These knots. [K]
        shadows: Caster, a class, of each group from B on.
        normal: Normal of the plane that carries shadows. [3]
        light: Light of the shading. [3]
    """
    at = knots(times, motion.horizon)
    rows, means = movers, gaussians["means"][movers]
    quats = rotations.normalize(gaussians["quats"][movers])
    states = [motion.deltas(means, float(t)) for t in at]
    path = torch.stack([means + s.offsets for s in states], 1).numpy().astype(np.float64)
    turns = torch.stack([rotations.multiply(s.quats, quats) for s in states], 1).numpy().astype(np.float64)
    sizes = torch.stack([gaussians["log_scales"][movers] + s.log_scales for s in states], 1).numpy()
    state = motion.state(means + states[-1].offsets, motion.horizon)
    dynamics = np.zeros((len(gaussians["means"]), 12))
    dynamics[rows.numpy()] = _about_own_centre(path[:, -1], state, motion.clock.scale)
    bind = {name: tensor.numpy().copy() for name, tensor in gaussians.items()}
    canonical = bind["means"].copy()
    for name, value in (("means", path[:, -1]), ("quats", turns[:, -1]), ("log_scales", sizes[:, -1])):
        bind[name][rows.numpy()] = value
    sh = np.concatenate([bind["sh"], bind["sh_rest"]], axis=1).astype(np.float64)[rows.numpy()]
    since = states[-1].quats.numpy().astype(np.float64)
    sh = spherical_harmonics.rotate(sh, since)
    ones = np.ones(len(sh))
    sh, vectors, lit = shading.rebind(sh, bind["shading"][rows.numpy()].astype(np.float64), ones, since, light)
    bind["shading_rest"] = np.ones(len(labels))
    bind["shading_rest"][rows.numpy()] = lit
    for name, value in (("sh", sh[:, :1]), ("sh_rest", sh[:, 1:]), ("shading", vectors)):
        bind[name][rows.numpy()] = value
    motion_ids = np.zeros(len(labels), np.int64)
    own = gaussians["motion_ids"].numpy()[rows.numpy()]
    own = np.where(own == len(object_ids) + len(shadows), labels[rows.numpy()], own)  # what moves in no group
    if not own.any():  # nobody said what belongs to what before training: the labels do
        own = labels[rows.numpy()].astype(np.int64)
    motion_ids[rows.numpy()] = own
    resting = ~np.isin(labels, own)  # objects of which nothing moves are groups all the same
    motion_ids[resting] = labels[resting]
    opacities = 1 / (1 + np.exp(-gaussians["opacity_logits"].numpy()[rows.numpy()].astype(np.float64)))
    nearest = np.abs(times[None] - at[:, None]).argmin(1)
    still = rotations.identity(len(at)), np.zeros((len(at), 3))
    groups = [GroupTrack(0, "pinned", np.zeros(3), *still, np.ones(len(at), bool))]
    for row in range(1, len(object_ids)):
        observed = seen[row - 1][nearest].copy()
        observed[-1] = True
        members = own == row
        center, quat, shift = _track(path[members], opacities[members])
        groups.append(GroupTrack(int(object_ids[row]), "body", center, quat, shift, observed))
    for k, caster in enumerate(shadows):
        members = own == len(object_ids) + k
        leader = groups[caster]
        matrix = _follow(path[members], opacities[members], leader.displacements, normal)
        center = np.average(path[members, -1], axis=0, weights=opacities[members]) if members.any() else leader.center
        shift = leader.displacements @ matrix.T
        groups.append(GroupTrack(leader.object_id, "shadow", center, still[0], shift, leader.observed, caster, matrix))
    points = PointMotion(rows.numpy(), path, turns, sizes.astype(np.float64), dynamics, canonical)
    return ObservedMotion(at, tuple(groups), light, bind, motion_ids, points)


def _track(path: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre at the last knot, rotations [S, 4] and displacements of the centre [S, 3] since then."""
    count = path.shape[1]
    quats, shifts = rotations.identity(count), np.zeros((count, 3))
    if len(path) == 0:
        return np.zeros(3), quats, shifts
    center = np.average(path[:, -1], axis=0, weights=weights)
    for k in range(count - 2, -1, -1):
        fit = poses.fit_rigid(path[:, -1], path[:, k], weights, hint=quats[k + 1])
        quats[k], shifts[k] = fit.quat, fit.displacement_at(center)
    return center, quats, shifts


def _follow(path: np.ndarray, weights: np.ndarray, leader: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Linear map from a caster's displacements to its shadow's, near the projection onto the plane. [3, 3]"""
    flat = np.eye(3) - np.outer(normal, normal)
    if len(path) == 0:
        return flat
    moved = np.average(path - path[:, -1:], axis=0, weights=weights)
    gram = leader.T @ leader
    ridge = SHADOW_RIDGE * np.trace(gram) / 3 + 1e-9
    return np.linalg.solve(gram + ridge * np.eye(3), leader.T @ moved + ridge * flat.T).T


def _about_own_centre(points: np.ndarray, state, scale: float) -> np.ndarray:
    """Velocity, angular velocity and their rates per scene time, about each Gaussian's own centre. [R, 12]"""
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

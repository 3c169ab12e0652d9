"""Motion of groups past t_max: the model fitted to their observed poses, or one twist from their members' own dynamics.

Notation: a group rotates about its pivot p; a member at y_i = p + r_i has a twist (v_i, w_i) with rates (a_i, e_i)
about its own centre. Expressed about the pivot (`se3.recentre`), the twists of a rigid body's members are equal and can
be compared and averaged. About a distant origin they would lose precision to cancellation.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from ..motion import (
    cubic_curves,
    levenberg_marquardt,
    models,
    rigid_fit,
    robust_weights,
    rotations,
    se3,
    twist_propagation,
)
from ..motion import joint as joints
from ..motion.joint import Joint
from ..motion.models import STATIC, MotionModel
from ..scene import visibility
from ..scene.scene import MotionGroup, Scene
from ..scene.splats import to_opacities
from . import observed_motion
from .modes import SOURCES

FARTHEST = 1e30  # maximum predicted displacement per axis, within the range of float32
HORIZON = 1 / 3  # fraction of the observed span past t_max over which "kabsch" follows the members
_FUTURES = 6  # number of times within the horizon
_ROUNDS = 6  # reweighting rounds
_TOLERANCE = 1e-6  # in radii of the group


def models_of(scene: Scene, source: str = "fitted") -> tuple[MotionModel, ...]:
    """Motion models of all groups past t_max, from one source.

    Args:
        scene: The scene; every source but "fitted" requires its `dynamics`.
        source: "fitted": the model fitted to the observed poses. The others combine the members' dynamics about the
            pivot into a "world_twist": "representative" takes that of the group's representative; "median" the median
            by component; "least_squares" the twist that best fits the members' velocities and accelerations; "kabsch"
            the twist whose motion best fits the positions predicted by the members' own dynamics.

    Returns:
        One model per group; static for pinned groups and for those that follow another.

    Raises:
        ValueError: The source is unknown, or the scene has no dynamics.

    Source: "representative" is the paper's anchor. Members fainter than `visibility.SEEN_OPACITY` are
        excluded; fits are weighted by opacity and robust (Cauchy).
    """
    if source not in SOURCES:
        raise ValueError(f"source: expected one of {', '.join(SOURCES)}, got {source!r}")
    if source == "fitted":
        return tuple(group.model for group in scene.groups)
    if scene.dynamics is None:
        raise ValueError(f"source: expected 'fitted', as the scene {scene.name!r} has no dynamics, got {source!r}")
    return tuple(_model_of(scene, group, source) for group in scene.groups)


class GroupMotion:
    """Poses of all motion groups of a scene at any time. Time-independent quantities are computed once.

    Args:
        scene: The scene.
        source: Source of the motion past t_max, one of `SOURCES`.
    """

    def __init__(self, scene: Scene, source: str = "fitted"):
        self._times, self._t_max = scene.tracks.times, scene.t_max
        self._scene, self._source = scene, source
        self._quats, self._displacements = knot_poses(scene)
        self._parts = parts_of(scene.groups)
        if self._parts:
            self._displacements = self._displacements.copy()
        for part, _ in self._parts:
            self._quats[part.id], self._displacements[part.id] = local_knots(scene, part)
        self._slopes = (
            cubic_curves.slopes(self._times, self._quats),
            cubic_curves.slopes(self._times, self._displacements),
        )
        self._jumping = {
            g: observed_motion.curves(scene, group, self._quats[g], self._displacements[g])
            for g, group in enumerate(scene.groups)
            if observed_motion.jumps(scene, group)
        }
        self._followers = [
            (g, group.follows, group.follow_matrix)
            for g, group in enumerate(scene.groups)
            if group.follows is not None and group.follow_matrix is not None
        ]

    @functools.cached_property
    def models(self) -> tuple[MotionModel, ...]:
        """Motion model of each group past t_max."""
        return models_of(self._scene, self._source)

    @functools.cached_property
    def _future(self) -> models.MotionStack:
        own = [STATIC if g.follows is not None else m for g, m in zip(self._scene.groups, self.models, strict=True)]
        return models.MotionStack(own)

    def poses(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Pose of every group relative to the bind state, as from `scene_player.Player.group_poses`."""
        if not np.isfinite(t):
            raise ValueError(f"t: expected a finite scene time, got {t}")
        if t < self._t_max:
            return self._observed(t)
        quats, displacements = self._future.poses(t - self._t_max)
        if self._source == "fitted":
            for part, joint in self._parts:
                quats[part.id], displacements[part.id] = joint.poses(t - self._t_max)
            self._compose_parts(quats, displacements)
        for g, leader, matrix in self._followers:
            displacements[g] = matrix @ displacements[leader]
        return quats, displacements.clip(-FARTHEST, FARTHEST)

    def _observed(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        times = self._times
        if t <= times[0]:
            quats, displacements = rotations.normalize(self._quats[:, 0]), self._displacements[:, 0].copy()
            self._compose_parts(quats, displacements)
            return quats, displacements
        k, h, u = cubic_curves.locate(times, t)
        q, d = (
            cubic_curves.hermite(values[:, k], values[:, k + 1], slopes[:, k], slopes[:, k + 1], h, u)
            for values, slopes in zip((self._quats, self._displacements), self._slopes, strict=True)
        )
        for g, curves in self._jumping.items():
            q[g] = cubic_curves.evaluate(curves.rotation, np.array(t))
            d[g] = cubic_curves.evaluate(curves.location, np.array(t))
        q = rotations.normalize(q)
        self._compose_parts(q, d)
        return q, d

    def _compose_parts(self, quats: np.ndarray, displacements: np.ndarray) -> None:
        """Replace the motion of parts relative to their parents by that in the world, in place. [G, 4], [G, 3]"""
        for part, joint in self._parts:
            assert part.parent is not None
            parent = quats[part.parent], displacements[part.parent]
            own = quats[part.id], displacements[part.id]
            pivot = self._scene.groups[part.parent].pivot
            quats[part.id], displacements[part.id] = joints.composed(parent, pivot, own, joint.point, part.pivot)


def parts_of(groups: Sequence[MotionGroup]) -> list[tuple[MotionGroup, Joint]]:
    """Return the groups with a parent, and their joints; parents come before their children.

    Raises:
        ValueError: The parents form a circle, or one is missing.
    """
    found, known = [], {g.id for g in groups if g.joint is None}
    waiting = [g for g in groups if g.joint is not None]
    while waiting:
        ready = [g for g in waiting if g.parent in known]
        if not ready:
            raise ValueError("groups: the parents form a circle, or one is missing")
        found += [(g, g.joint) for g in ready if g.joint is not None]
        known |= {g.id for g in ready}
        waiting = [g for g in waiting if g.id not in known]
    return found


def local_knots(scene: Scene, group: MotionGroup) -> se3.Pose:
    """Poses of a group, as from `knot_poses`; for a part, its poses relative to its parent, about the joint's point.

    [S, 4], [S, 3]
    """

    def world(row: int) -> se3.Pose:
        quats, displacements = knot_poses(scene, slice(row, row + 1))
        return quats[0], displacements[0]

    if group.parent is None or group.joint is None:
        return world(group.id)
    above = scene.groups[group.parent]
    quats, moves = joints.relative(world(above.id), above.pivot, world(group.id), group.pivot, group.joint.point)
    return rotations.make_continuous(quats[::-1])[::-1], moves


def knot_poses(scene: Scene, groups: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Poses at the observed times, with sign-continuous quaternions that end at (1, 0, 0, 0).

    Args:
        scene: The scene.
        groups: The G motion groups to return; all by default.

    Returns:
        Quaternions [G, S, 4] and displacements [G, S, 3], float64.
    """
    poses = np.asarray(scene.tracks.poses[groups], np.float64)
    quats = np.moveaxis(poses[..., :4], 1, 0)
    quats = rotations.make_continuous(quats[::-1])[::-1]
    quats = np.where(quats[-1:, :, :1] < 0, -quats, quats)
    return np.moveaxis(quats, 0, 1), poses[..., 4:]


def opaque_members(scene: Scene, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that are opaque enough to represent a group, or all if none is, and their opacities. [n] each"""
    with np.errstate(over="ignore"):
        opacities = to_opacities(scene.gaussians.opacity_logits[rows])
    seen = visibility.seen(opacities)
    return rows[seen], np.maximum(opacities[seen], 1e-12)


def representative(scene: Scene, rows: np.ndarray) -> int:
    """Row of the opaque Gaussian nearest to the centroid of the given ones, at least one."""
    rows, _ = opaque_members(scene, rows)
    points = scene.gaussians.means[rows].astype(np.float64)
    return int(rows[np.argmin(((points - points.mean(0)) ** 2).sum(-1))])


def _model_of(scene: Scene, group: MotionGroup, source: str) -> MotionModel:
    assert scene.dynamics is not None
    rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
    if group.role == "pinned" or group.follows is not None or len(rows) == 0:
        return STATIC
    rows, weights = opaque_members(scene, rows)
    if source == "representative":
        rows, weights = (np.array([group.anchor_index]), np.ones(1)) if group.anchor_index >= 0 else (rows, weights)
    arms = scene.gaussians.means[rows].astype(np.float64) - group.pivot
    states = scene.dynamics.rates[rows].astype(np.float64)
    radius = max(float(np.quantile(np.linalg.norm(arms, axis=-1), 0.98)), 1e-9 * scene.extent)
    if not states.any():
        return MotionModel(radius=radius)
    v, w, a, e = np.split(states, 4, axis=-1)
    about_pivot = np.concatenate([*se3.recentre(w, v, e, a, -arms), w, e], axis=-1)  # v, a, w, e
    twist = np.median(about_pivot, axis=0)
    span = float(scene.tracks.times[-1] - scene.tracks.times[0]) * HORIZON or 1.0
    if source in ("least_squares", "kabsch"):
        twist = _least_squares(arms, states, weights, twist, span)
    if source == "kabsch":
        twist = _twist_of_registrations(arms, states, weights, twist, span, radius)
    return _world_twist(twist, radius)


def _world_twist(twist: np.ndarray, radius: float) -> MotionModel:
    """Motion model from v, a, w, e about the pivot. [12]"""
    v, a, w, e = np.split(twist, 4)
    return MotionModel(
        "world_twist", velocity=v, acceleration=a, angular_velocity=w, angular_acceleration=e, radius=radius
    )


def _least_squares(
    arms: np.ndarray,  # [n, 3]
    states: np.ndarray,  # [n, 12]
    weights: np.ndarray,  # [n]
    guess: np.ndarray,  # [12]
    span: float,
) -> np.ndarray:  # [12]
    """Twist v, a, w, e about the pivot that best fits the members' velocities and accelerations.

    Training observes only v + w x r, so a member's own spin is used only about axes that the members' velocities leave
    undetermined.

    Source: velocity v + w x r, acceleration a + e x r + w x (v + w x r).
    """
    v_i, w_i, a_i, _ = np.split(states, 4, axis=-1)
    v, w = _fit_velocity_field(arms, v_i, weights, guess[6:9], rigid_fit.UNDETERMINED_RAD / span)
    bent = a_i + rotations.cross(w_i, v_i) - rotations.cross(w, v + rotations.cross(w, arms))
    a, e = _fit_velocity_field(arms, bent, weights, guess[9:], 2 * rigid_fit.UNDETERMINED_RAD / span**2)
    return np.concatenate([v, a, w, e])


def _fit_velocity_field(
    arms: np.ndarray, speeds: np.ndarray, weights: np.ndarray, guess: np.ndarray, doubt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Robust fit of a field v + w x r to vectors at points r; returns v and w.

    Args:
        arms: r. [n, 3]
        speeds: The vectors. [n, 3]
        weights: Weights, > 0. [n]
        guess: Value of w about undetermined axes. [3]
        doubt: Standard deviation of w above which an axis counts as undetermined.
    """
    current, center, mean, w = weights / weights.sum(), arms[0], speeds[0], guess
    for remaining in range(_ROUNDS, -1, -1):
        center, mean = current @ arms, current @ speeds
        x, u = arms - center, speeds - mean
        values, axes = np.linalg.eigh(np.einsum("n,nij->ij", current, rigid_fit.inertias(x)))
        torque = current @ rotations.cross(x, u)
        floor = 1e-12 * max(float(values[-1]), 1e-300)
        w = axes @ (axes.T @ torque / np.maximum(values, floor))
        errors = u - rotations.cross(w, x)
        relative = current / current.max()
        variance = (relative @ (errors**2).sum(-1)) / max(3 * relative.sum() - 6, 1.0) / relative.sum()
        open_axes = (values <= floor) | (variance > doubt**2 * np.maximum(values, floor))
        w = axes @ np.where(open_axes, axes.T @ guess, axes.T @ w)
        distances = np.linalg.norm(u - rotations.cross(w, x), axis=-1)
        largest = float(np.abs(speeds).max())
        if remaining == 0 or not robust_weights.has_outliers(distances, 1e-12 * largest):
            break
        current = robust_weights.reweight(weights, distances, robust_weights.cauchy_scale(distances, 1e-9 * largest))
        current = current / current.sum()
    return mean - rotations.cross(w, center), w


def _twist_of_registrations(
    arms: np.ndarray, states: np.ndarray, weights: np.ndarray, guess: np.ndarray, span: float, radius: float
) -> np.ndarray:
    """Twist nearest to the rigid registrations of the members at several times up to ``span``."""
    taus = span * np.arange(1, _FUTURES + 1) / _FUTURES
    quats, displacements = np.empty((_FUTURES, 4)), np.empty((_FUTURES, 3))
    future = twist_propagation.Propagator(states, _TOLERANCE * radius)
    hints = models.evaluate(_world_twist(guess, radius), taus)[0]
    for k, tau in enumerate(taus):
        moves = future.rows_of(float(tau))[1]
        fit = rigid_fit.fit_rigid(arms, arms + moves, weights, hint=hints[k])
        quats[k], displacements[k] = fit.quat, fit.displacement_at(np.zeros(3))
    return _fit_twist(taus, quats, displacements, guess, radius)


def _fit_twist(
    taus: np.ndarray, quats: np.ndarray, displacements: np.ndarray, guess: np.ndarray, radius: float
) -> np.ndarray:
    """Fit the twist v, a, w, e to poses by least squares from an initial guess. [12]"""
    span = float(taus[-1])
    units = np.repeat([radius / span, radius / span**2, 1 / span, 1 / span**2], 3)

    def errors(batch: np.ndarray) -> np.ndarray:  # [B, 12] -> [B, K, 6], in radii
        v, a, w, e = (part[:, None] for part in np.split(batch * units, 4, axis=-1))
        durations = np.broadcast_to(taus, (len(batch), len(taus)))
        needed = se3.steps_needed(w, v, e, a, durations, radius, _TOLERANCE * radius)
        steps = int(min(needed.max(), twist_propagation.MAX_STEPS))
        return se3.differences(se3.integrate(w, v, e, a, durations, steps), (quats, displacements), radius, 1.0)

    return levenberg_marquardt.solve(errors, guess / units, steps=20).x * units

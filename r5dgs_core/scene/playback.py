"""A scene at any time: poses of its motion groups, and its Gaussians moved by them.

Between the observed times each component of displacement and quaternion is a cubic Hermite curve through the knots
(the quaternion is normalised afterwards), with slopes of the parabola through each knot and its two neighbours.
Blender's Bezier keys with handles at a third of the interval are the same curve, so keys at the knots reproduce
playback at sub-frames. Before the first knot the pose is held; past t_max it is the motion model's, or what another
mode says (`modes`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..motion import keyframes, models, rotations
from ..motion.keyframes import slopes
from . import residuals
from .scene import Scene

MODES = ("rigid", "standard", "rigid_paper")


@dataclass(frozen=True)
class Frame:
    """The Gaussians of a scene at time t.

    `sh` stays in the frame of the bind state: a renderer turns each viewing direction back by the group's rotation
    (`sh_rotations`) instead of turning the coefficients.

    Attributes:
        t: Scene time.
        means: Centres, world. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: As in the scene. [N, 3] float32
        opacity_logits: As in the scene. [N] float32
        sh: As in the scene, bind frame. [N, K, 3] float32
        shading_factor: Factor on the colour, >= 0, or None without shading. [N] float32
        object_ids: [N] int32
        motion_ids: [N] int32
        group_quats: Rotation of each motion group since the bind state, unit wxyz. [G, 4] float64
        group_displacements: Displacement of each group's pivot, world. [G, 3] float64
    """

    t: float
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    shading_factor: np.ndarray | None
    object_ids: np.ndarray
    motion_ids: np.ndarray
    group_quats: np.ndarray
    group_displacements: np.ndarray


def knots(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Poses at the observed times with signs chosen so that quaternions are continuous and end at (1, 0, 0, 0).

    Returns:
        Quaternions [G, S, 4] and displacements [G, S, 3], float64.
    """
    quats = np.moveaxis(np.asarray(scene.track_poses[..., :4], np.float64), 1, 0)
    quats = rotations.make_continuous(quats[::-1])[::-1]
    quats = np.where(quats[-1:, :, :1] < 0, -quats, quats)
    return np.moveaxis(quats, 0, 1), np.asarray(scene.track_poses[..., 4:], np.float64)


def knot_slopes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Slopes at the knots of `knots`, per unit of scene time: quaternions [G, S, 4] and displacements [G, S, 3]."""
    quats, displacements = knots(scene)
    return slopes(scene.track_times, quats), slopes(scene.track_times, displacements)


def group_poses(scene: Scene, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Pose of every motion group relative to the bind state.

    Args:
        scene: The scene.
        t: Scene time; before the first knot the first pose is held.

    Returns:
        Unit quaternions wxyz [G, 4] and displacements of the pivots, world [G, 3], float64. At t_max exactly the
        identity; a group that `follows` another takes its displacement through `follow_matrix` past t_max.
    """
    if not np.isfinite(t):
        raise ValueError(f"t: expected a finite scene time, got {t}")
    if t < scene.t_max:
        return _observed_poses(scene, t)
    count = len(scene.groups)
    quats, displacements = rotations.identity(count), np.zeros((count, 3))
    tau = t - scene.t_max
    leaders = [g for g, group in enumerate(scene.groups) if group.follows is None]
    quats[leaders], displacements[leaders] = models.evaluate_all([scene.groups[g].model for g in leaders], tau)
    for g, group in enumerate(scene.groups):
        if group.follows is not None and group.follow_matrix is not None:
            displacements[g] = group.follow_matrix @ displacements[group.follows]
    return quats, displacements


def _observed_poses(scene: Scene, t: float) -> tuple[np.ndarray, np.ndarray]:
    times = scene.track_times
    quats, displacements = knots(scene)
    if t <= times[0]:
        return rotations.normalize(quats[:, 0]), displacements[:, 0].copy()
    k = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
    h = times[k + 1] - times[k]
    u = (t - times[k]) / h
    quat_slopes, displacement_slopes = slopes(times, quats), slopes(times, displacements)
    q = keyframes.hermite(quats[:, k], quats[:, k + 1], quat_slopes[:, k], quat_slopes[:, k + 1], h, u)
    d = keyframes.hermite(
        displacements[:, k], displacements[:, k + 1], displacement_slopes[:, k], displacement_slopes[:, k + 1], h, u
    )
    return rotations.normalize(q), d


def sh_rotations(group_quats: np.ndarray) -> np.ndarray:
    """Matrices that bring world directions into each group's bind frame, for evaluating SH. [G, 4] -> [G, 3, 3]"""
    return np.swapaxes(rotations.quats_to_rotmats(group_quats), -1, -2)


def runs(ids: np.ndarray) -> list[tuple[int, int, int]]:
    """Stretches of equal ids as (start, stop, id). [N]"""
    if len(ids) == 0:
        return []
    cuts = np.flatnonzero(ids[1:] != ids[:-1]) + 1
    starts = np.concatenate([[0], cuts])
    stops = np.concatenate([cuts, [len(ids)]])
    return [(int(a), int(b), int(ids[a])) for a, b in zip(starts, stops, strict=True)]


def modes(scene: Scene) -> tuple[str, ...]:
    """The modes that a scene holds data for: `rigid` always, the others where it carries dynamics of its Gaussians."""
    present = (True, scene.dynamics is not None, scene.dynamics is not None and scene.canonical_means is not None)
    return tuple(mode for mode, there in zip(MODES, present, strict=True) if there)


def frame(scene: Scene, t: float, mode: str = "rigid") -> Frame:
    """The scene's Gaussians at time t.

    Args:
        scene: The scene.
        t: Scene time.
        mode: How Gaussians move past t_max. "rigid": with their motion group; "standard": each by its own dynamics;
            "rigid_paper": Eq. 6 and 7 to the letter. Up to t_max all are the same.

    Returns:
        The frame. Gaussians that did not move are equal to the bind state to the bit.

    Raises:
        ValueError: There is no such mode, or the scene holds no data for it (`modes`).
    """
    if mode not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
    if mode not in modes(scene):
        raise ValueError(f"mode: the scene {scene.name!r} has {', '.join(modes(scene))}, not {mode!r}")
    if mode == "rigid" or t <= scene.t_max:
        group_quats, group_displacements = group_poses(scene, t)
        bind, turns = residuals.deformed(scene, t)
        posed = pose(bind, group_quats, group_displacements, t)
        if turns is None or scene.residual_rows is None:
            return posed
        rows = scene.residual_rows
        return _relight(scene, posed, rows, rotations.multiply(group_quats[scene.motion_ids[rows]], turns))
    move = residuals.standard if mode == "standard" else residuals.literal
    means, quats, turns = move(scene, t - scene.t_max)
    bind = pose(scene, rotations.identity(len(scene.groups)), np.zeros((len(scene.groups), 3)), t)
    return _relight(scene, dataclasses.replace(bind, means=means, quats=quats), np.arange(len(means)), turns)


def _relight(scene: Scene, posed: Frame, rows: np.ndarray, turns: np.ndarray) -> Frame:
    """The frame with the shading of Gaussians that turned on their own. rows [R], turns since t_max [R, 4]"""
    vectors, light = scene.shading, scene.light_direction
    if posed.shading_factor is None or vectors is None or light is None:
        return posed
    change = rotations.rotate(rotations.conjugate(turns), light) - light
    factor = posed.shading_factor.copy()
    factor[rows] = np.maximum(rest_factors(scene)[rows] + (vectors[rows] * change).sum(-1), 0)
    return dataclasses.replace(posed, shading_factor=factor)


def rest_factors(scene: Scene) -> np.ndarray:
    """Factor of each Gaussian's colour in the bind state, before it is bounded at 0. [N] float32"""
    rest = scene.shading_rest
    return np.ones(len(scene.means), np.float32) if rest is None else rest


def pose(scene: Scene, group_quats: np.ndarray, group_displacements: np.ndarray, t: float = float("nan")) -> Frame:
    """The scene's Gaussians with each motion group in a given pose.

    Args:
        scene: The scene.
        group_quats: Rotation of each group about its pivot, unit wxyz. [G, 4]
        group_displacements: Displacement of each pivot, world. [G, 3]
        t: Time written into the frame.
    """
    means, quats = scene.means, scene.quats
    gradients, light = scene.shading, scene.light_direction
    rest = rest_factors(scene)
    shading = None if gradients is None or light is None else np.maximum(rest, 0)
    rotmats = rotations.quats_to_rotmats(group_quats)
    moved = np.flatnonzero((group_quats[:, 1:] != 0).any(-1) | (group_displacements != 0).any(-1))
    if len(moved):
        means, quats = means.copy(), quats.copy()
    for start, stop, g in runs(scene.motion_ids):
        if g not in moved:
            continue
        rows, pivot = slice(start, stop), np.asarray(scene.groups[g].pivot, np.float64)
        shift = pivot + group_displacements[g] - rotmats[g] @ pivot
        move_points(scene.means[rows], rotmats[g], shift, means[rows])
        turn_quats(scene.quats[rows], group_quats[g], quats[rows])
        if shading is not None and gradients is not None and light is not None:
            change = (rotmats[g].T @ light - light).astype(np.float32)
            shading[rows] = np.maximum(rest[rows] + gradients[rows] @ change, 0)
    return Frame(
        t=float(t),
        means=means,
        quats=quats,
        log_scales=scene.log_scales,
        opacity_logits=scene.opacity_logits,
        sh=scene.sh,
        shading_factor=shading,
        object_ids=scene.object_ids,
        motion_ids=scene.motion_ids,
        group_quats=group_quats,
        group_displacements=group_displacements,
    )


def move_points(points: np.ndarray, linear: np.ndarray, shift: np.ndarray, result: np.ndarray) -> None:
    """Write ``linear p + shift`` for each point p to ``result``, computed in float64.

    Args:
        points: [N, 3] float32
        linear: [3, 3] float64
        shift: [3] float64
        result: Not ``points``. [N, 3] float32
    """
    turned = points.astype(np.float64) @ linear.T
    for axis in range(3):  # a column at a time: numpy is slow at rows of three
        np.add(turned[:, axis], shift[axis], out=result[:, axis], casting="same_kind")


def turn_quats(quats: np.ndarray, turn: np.ndarray, result: np.ndarray) -> None:
    """Write the products ``turn q`` to ``result``, computed in float64.

    Args:
        quats: Unit wxyz. [N, 4] float32
        turn: Unit wxyz. [4] float64
        result: Not ``quats``. [N, 4] float32
    """
    # Linear in q: row k of the matrix is the product with the k-th unit quaternion.
    result[:] = quats.astype(np.float64) @ rotations.multiply(turn, np.eye(4))

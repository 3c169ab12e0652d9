"""Small scenes for the stability table: bodies of known motion in float32, as in a scene file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..motion import models, rotations, se3
from ..motion.models import MotionModel
from ..scene.scene import Dynamics, Gaussians, MotionGroup, Scene, SceneObject, Tracks
from .cases import body, model_of

T_MAX = 0.75
TIMES = np.linspace(0.0, T_MAX, 16)
HORIZON = 100 * T_MAX
MODES = ("rigid", "hybrid", "standard")
EVERY_MODE = (*MODES, "rigid_paper")
FUTURES = (T_MAX + 1e-9, 1.0, 2.0, 10.0, HORIZON)
PAST = (0.0, 0.123, 0.4, 0.74)
DIAGONAL = np.array([0.6, -0.48, 0.64])

MOTIONS: dict[str, MotionModel] = {
    "static": model_of("static"),
    "translation": model_of(
        "translation",
        velocity=[0.5, 0, 0.2],
        acceleration=[0, 0.1, -0.3],
    ),
    "ballistic spin": model_of(
        "ballistic_spin",
        velocity=[0.1, 0, 0.2],
        acceleration=[0, 0, -0.5],
        angular_velocity=[1, 2, 0.5],
        angular_acceleration=[0.2, -0.1, 0.3],
        offset_rotvec=[0.01, 0, -0.02],
        offset_displacement=[0.002, 0.001, 0],
    ),
    "constant twist": model_of(
        "constant_twist",
        velocity=[0.5, 0, 0.3],
        angular_velocity=[0.4, 0.2, 2],
    ),
    "world twist": model_of(
        "world_twist",
        velocity=[0.2, 0, 0.1],
        acceleration=[0.001, 0, -0.002],
        angular_velocity=[0.3, -0.2, 0.9],
        angular_acceleration=[0.004, 0.01, -0.008],
    ),
    "pendulum": model_of(
        "ballistic_spin",
        angular_velocity=[0, 0.9, 0.3],
        angular_acceleration=[0, -3.6, -1.2],
        center_offset=[0.2, -0.2, 0.6],
        frequency=5.0,
    ),
    "free top": model_of(
        "free_top",
        velocity=[0.1, 0, 0.2],
        acceleration=[0, 0, -0.5],
        angular_velocity=[0.3, 2.0, 0.2],
    ),
}


def scene_of(
    clouds: Sequence[np.ndarray],
    motions: Sequence[MotionModel],
    *,
    singles: bool = False,
    times: np.ndarray = TIMES,
) -> Scene:
    """Return a scene of bodies with an empty background.

    Args:
        clouds: Points of each body in the bind state, any number of them. [n, 3] each
        motions: Motion of each body past t_max. Its curve before t_max is the track.
        singles: Give every Gaussian the dynamics of its body, relative to its own center, and a canonical state, so
            that the scene plays in every mode.
        times: Knots. [S]
    """
    groups = [MotionGroup(0, 0, "pinned", -1, np.zeros(3), models.STATIC)]
    tracks, table, start = [_track(models.STATIC, times)], [_object(0, 0, 0)], 0
    states = []
    for k, (cloud, motion) in enumerate(zip(clouds, motions, strict=True), start=1):
        means = np.asarray(cloud, np.float32).astype(np.float64).reshape(-1, 3)
        pivot = means.mean(0) if len(means) else np.zeros(3)
        arms = means - pivot
        anchor = start + int(np.argmin(np.linalg.norm(arms, axis=-1))) if len(means) else -1
        groups.append(MotionGroup(k, k, "body", anchor, pivot, motion))
        tracks.append(_track(motion, times))
        table.append(_object(k, start, len(means)))
        start += len(means)
        w, e = motion.angular_velocity, motion.angular_acceleration
        v, a = se3.recentre(w, motion.velocity, e, motion.acceleration, arms)
        states.append(np.concatenate([v, w + 0 * arms, a, e + 0 * arms], axis=-1))
    ids = np.repeat(np.arange(1, len(clouds) + 1), [item.count for item in table[1:]]).astype(np.int32)
    means = np.concatenate([np.zeros((0, 3)), *clouds]).astype(np.float32)
    members = np.concatenate([np.zeros((0, 12)), *states]).astype(np.float32)
    return Scene(
        name="stability",
        gaussians=Gaussians(
            means=means,
            quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
            log_scales=np.full((len(means), 3), -4, np.float32),
            opacity_logits=np.full(len(means), 4, np.float32),
            sh=np.zeros((len(means), 1, 3), np.float32),
            object_ids=ids,
            motion_ids=ids.copy(),
        ),
        objects=tuple(table),
        groups=tuple(groups),
        tracks=Tracks(times=times, poses=np.stack(tracks)),
        t_max=float(times[-1]),
        frames_per_unit=60.0,
        world_convention="blender",
        cameras=(),
        background_sh=np.zeros((1, 3), np.float32),
        dynamics=Dynamics(members, means.copy()) if singles else None,
    )


def every_motion(distance: float = 0.0, *, singles: bool = False) -> Scene:
    """Return a scene with one body for each of `MOTIONS`, all at one distance from the origin."""
    centers = distance * DIAGONAL + np.arange(len(MOTIONS))[:, None] * np.array([1.0, 0, 0])
    return scene_of([body() + c for c in centers], list(MOTIONS.values()), singles=singles)


def _track(motion: MotionModel, times: np.ndarray) -> np.ndarray:
    """Return poses at the knots relative to the bind state; the last one is exactly the identity. [S, 7]"""
    quats, displacements, _, _ = models.curve(motion, times - times[-1])
    return np.concatenate([rotations.normalize(quats), displacements], axis=-1)


def _object(object_id: int, start: int, count: int) -> SceneObject:
    name = f"body {object_id}" if object_id else "background"
    return SceneObject(object_id, name, (), "", (0.5, 0.5, 0.5), start, count)

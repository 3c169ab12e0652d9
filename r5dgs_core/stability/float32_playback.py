"""Stability cases on playback in float32: distances inside bodies, positions and unit quaternions."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..motion import models, rotations
from ..playback import scene_player
from .cases import RADIUS, Case, Twist, body, largest, rk2_points, shape_error
from .scenes import DIAGONAL, FUTURES, HORIZON, MODES, MOTIONS, PAST, T_MAX, every_motion

_FLOAT32 = "rounding of float32"
_DISTANCE = "largest relative change of a distance"


def _distances(distance: float, mode: str = "rigid") -> float:
    """Largest relative change of a distance inside a body, over all motions, up to 100 times the observed time.

    Frames are float32, relative to the body's position, as a camera near the body needs them.
    """
    scene, worst = every_motion(distance, singles=mode != "rigid"), 0.0
    for t in (*PAST, *FUTURES):
        quats, displacements = scene_player.Player(scene).group_poses(t)
        for g in range(1, len(scene.groups)):
            rows = np.flatnonzero(scene.gaussians.motion_ids == g)
            origin = scene.groups[g].pivot + displacements[g]
            frame = scene_player.Player(scene, mode).frame(t, origin=origin)
            worst = max(worst, shape_error(frame.means[rows], scene.gaussians.means[rows]))
    return worst


def _absolute(distance: float) -> float:
    """Like `_distances`, in absolute float32 coordinates; relative to the change that float32 spacing can cause."""
    scene, worst = every_motion(distance), 0.0
    shortest = float(np.linalg.norm(body()[0] - body()[1]))
    for t in FUTURES:
        frame = scene_player.Player(scene).frame(t)
        for g in range(1, len(scene.groups)):
            rows = np.flatnonzero(scene.gaussians.motion_ids == g)
            grid = float(np.spacing(np.abs(frame.means[rows]).max()))
            error = shape_error(frame.means[rows], scene.gaussians.means[rows])
            worst = max(worst, error / (math.sqrt(3) * grid / shortest))
    return worst


def _rk2_distances(distance: float) -> float:
    """Like `_distances`, for TRACE's integrator on each point in float32, about the world's origin."""
    model, center = MOTIONS["world twist"], distance * DIAGONAL
    twist = Twist(model.angular_velocity, model.velocity, model.angular_acceleration, model.acceleration)
    points = (body() + center).astype(np.float32)
    return shape_error(rk2_points(twist.about(center), HORIZON - T_MAX, points, 4455), body())


def _places(distance: float) -> float:
    """Largest error of float32 positions relative to their body against float64, over all motions, in radii."""
    scene, worst = every_motion(distance), 0.0
    for t in (1.0, HORIZON):
        for g in range(1, len(scene.groups)):
            group, rows = scene.groups[g], np.flatnonzero(scene.gaussians.motion_ids == g)
            pose = models.evaluate(group.model, t - T_MAX)
            origin = group.pivot + pose[1]
            expected = rotations.rotate(pose[0], scene.gaussians.means[rows].astype(np.float64) - group.pivot)
            frame = scene_player.Player(scene).frame(t, origin=origin)
            worst = max(worst, largest(frame.means[rows] - expected) / RADIUS)
    return worst


def _units(mode: str) -> float:
    """Largest deviation of a quaternion's length from 1, up to 100 times the observed time."""
    scene = every_motion(singles=True)
    quats = [scene_player.Player(scene, mode).frame(t).quats.astype(np.float64) for t in (*PAST, *FUTURES)]
    return float(np.abs(np.linalg.norm(np.stack(quats), axis=-1) - 1).max())


CASES: tuple[Case, ...] = (
    *(
        Case(
            "distances in a body",
            f"{label} from the origin, to 100 times the observed time",
            "playback.scene_player.Player.frame",
            _DISTANCE,
            1e-6,
            _FLOAT32,
            functools.partial(_distances, d),
            functools.partial(_rk2_distances, d),
        )
        for label, d in (("0", 0.0), ("100", 1e2), ("1e4", 1e4), ("1e6", 1e6))
    ),
    *(
        Case(
            "distances in a body",
            f"{label} from the origin, absolute float32",
            "playback.scene_player.Player.frame",
            "largest change / grid of float32 there",
            1.0,
            _FLOAT32,
            functools.partial(_absolute, d),
        )
        for label, d in (("0", 0.0), ("1e4", 1e4))
    ),
    *(
        Case(
            "distances in a body",
            f"places {label} from the origin, seen from the body",
            "playback.scene_player.Player.frame",
            "distance / radius",
            5e-7,
            _FLOAT32,
            functools.partial(_places, d),
        )
        for label, d in (("0", 0.0), ("1e4", 1e4))
    ),
    *(
        Case(
            "distances in a body",
            f"unit quaternions in float32, {mode}",
            "playback.scene_player.Player.frame",
            "| |q| - 1 |",
            3e-7,
            _FLOAT32,
            functools.partial(_units, mode),
            functools.partial(_units, "rigid_paper") if mode == "rigid" else None,
        )
        for mode in MODES
    ),
)

"""Stability cases on playback: distances in float32, random access, incomplete scenes."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math

import numpy as np

from ..motion import models, rotations
from ..motion.models import MotionModel
from ..playback import scene_player
from ..scene.scene import Scene
from .cases import RADIUS, Case, Twist, body, different, largest, model_of, rk2_points, shape_error
from .scenes import DIAGONAL, HORIZON, MOTIONS, T_MAX, every_motion, scene_of

_MODES = ("rigid", "hybrid", "standard")
_EVERY_MODE = (*_MODES, "rigid_paper")
_FUTURES = (T_MAX + 1e-9, 1.0, 2.0, 10.0, HORIZON)
_PAST = (0.0, 0.123, 0.4, 0.74)


def _distances(distance: float, mode: str = "rigid") -> float:
    """Largest relative change of a distance inside a body, over all motions, up to 100 times the observed time.

    Frames are float32, relative to the body's position, as a camera near the body needs them.
    """
    scene, worst = every_motion(distance, singles=mode != "rigid"), 0.0
    for t in (*_PAST, *_FUTURES):
        quats, displacements = scene_player.group_poses(scene, t)
        for g in range(1, len(scene.groups)):
            rows = np.flatnonzero(scene.gaussians.motion_ids == g)
            origin = scene.groups[g].pivot + displacements[g]
            frame = scene_player.frame(scene, t, mode, origin=origin)
            worst = max(worst, shape_error(frame.means[rows], scene.gaussians.means[rows]))
    return worst


def _absolute(distance: float) -> float:
    """Like `_distances`, in absolute float32 coordinates; relative to the change that float32 spacing can cause."""
    scene, worst = every_motion(distance), 0.0
    shortest = float(np.linalg.norm(body()[0] - body()[1]))
    for t in _FUTURES:
        frame = scene_player.frame(scene, t)
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
            frame = scene_player.frame(scene, t, origin=origin)
            worst = max(worst, largest(frame.means[rows] - expected) / RADIUS)
    return worst


def _units(mode: str) -> float:
    """Largest deviation of a quaternion's length from 1, up to 100 times the observed time."""
    scene = every_motion(singles=True)
    quats = [scene_player.frame(scene, t, mode).quats.astype(np.float64) for t in (*_PAST, *_FUTURES)]
    return float(np.abs(np.linalg.norm(np.stack(quats), axis=-1) - 1).max())


def _at_t_max(mode: str) -> float:
    """Number of values of the frame at t_max that differ from the bind state."""
    scene = every_motion(singles=True)
    frame = scene_player.frame(scene, scene.t_max, mode)
    return different(frame.means, scene.gaussians.means) + different(frame.quats, scene.gaussians.quats)


def _jump(mode: str) -> float:
    """Largest displacement of points from t_max to 1e-9 units before and after it, in radii."""
    scene = every_motion(singles=True)
    frames = [scene_player.frame(scene, scene.t_max + step, mode) for step in (-1e-9, 0.0, 1e-9)]
    return max(largest(frame.means.astype(np.float64) - frames[1].means) for frame in frames) / RADIUS


def _random_access(mode: str) -> float:
    """Number of values that differ between frames played in shuffled and in increasing order."""
    times = [*np.linspace(0, 3, 19).tolist(), 0.3, 3.0 if mode == "rigid_paper" else HORIZON]
    forward = [scene_player.frame(every_motion(singles=True), t, mode) for t in times]
    scene, count = every_motion(singles=True), 0.0
    for i in np.random.default_rng(8).permutation(len(times)):
        frame = scene_player.frame(scene, times[i], mode)
        count += different(frame.means, forward[i].means) + different(frame.quats, forward[i].quats)
    return count


def _agreement() -> float:
    """Largest difference between modes "standard" and "rigid" if all members share one twist, in radii."""
    scene, worst = every_motion(singles=True), 0.0
    rows = np.flatnonzero(scene.gaussians.motion_ids == list(MOTIONS).index("world twist") + 1)
    for t in (1.0, 2.0, 5.0):
        rigid, single = (
            scene_player.frame(scene, t, mode).means[rows].astype(np.float64) for mode in ("rigid", "standard")
        )
        worst = max(worst, largest(rigid - single) / RADIUS)
    return worst


def _ten_turns() -> float:
    """Largest quaternion step over ten observed and ten extrapolated turns, relative to the expected step."""
    model = model_of("ballistic_spin", angular_velocity=[0, 0, 20 * math.pi / T_MAX])
    scene = scene_of([body()], [model], times=np.linspace(0, T_MAX, 181))
    times = np.linspace(0, 2 * T_MAX, 361)
    quats = np.stack([scene_player.group_poses(scene, t)[0][1] for t in times])
    jumps = np.linalg.norm(np.diff(rotations.make_continuous(quats), axis=0), axis=-1)
    steps = np.sqrt(np.diff(times) * 20 * math.pi / T_MAX)
    return float((jumps / (2 * np.sin(steps**2 / 4))).max())


def _wild(scene: Scene, group: int, name: str, value: float) -> Scene:
    """Return the scene with invalid rates in a group, bypassing validation."""
    model = copy.copy(scene.groups[group].model)
    object.__setattr__(model, name, np.array([value, 0, value]))
    changed = dataclasses.replace(scene.groups[group], model=model)
    return dataclasses.replace(scene, groups=(*scene.groups[:group], changed, *scene.groups[group + 1 :]))


def _isolated(value: float) -> float:
    """Number of values of other groups that change if rates and track of one group are not finite."""
    scene, count = every_motion(), 0.0
    sound = {t: scene_player.frame(scene, t) for t in (0.4, 2.0)}
    for g in range(1, len(scene.groups)):
        broken = _wild(_wild(scene, g, "velocity", value), g, "angular_velocity", value)
        poses = scene.tracks.poses.copy()
        poses[g, :-1, 1:] = value
        broken = broken.with_arrays(track_poses=poses)
        others = scene.gaussians.motion_ids != g
        for t, expected in sound.items():
            frame = scene_player.frame(broken, t)
            count += different(frame.means[others], expected.means[others])
            count += different(frame.quats[others], expected.quats[others])
    return count


def _singles(value: float) -> tuple[float, float]:
    """Play mode "standard" with non-finite dynamics in one group at a time.

    Returns:
        Number of values that differ from a scene in which that group stands still, and the largest distance of the
        other groups from the valid scene, over the scene's extent.
    """
    scene, count, away = every_motion(singles=True), 0.0, 0.0
    assert scene.dynamics is not None
    sound = scene_player.frame(scene, 2.0, "standard")
    for g in range(1, len(scene.groups)):
        mine = scene.gaussians.motion_ids == g
        bad, still = (np.where(mine[:, None], np.float32(x), scene.dynamics.rates) for x in (value, 0.0))
        frame, expected = (
            scene_player.frame(scene.with_arrays(dynamics=states), 2.0, "standard") for states in (bad, still)
        )
        count += different(frame.means, expected.means) + different(frame.quats, expected.quats)
        away = max(away, largest(frame.means[~mine].astype(np.float64) - sound.means[~mine]) / scene.extent)
    return count, away


def _refused_rates() -> float:
    """Number of motion models with a NaN or infinite rate that are accepted."""
    accepted = 0
    for name in ("velocity", "acceleration", "angular_velocity", "angular_acceleration", "center_offset"):
        for value in (math.nan, math.inf):
            try:
                model_of("ballistic_spin", **{name: [0, value, 0]})
                accepted += 1
            except ValueError:
                pass
    return float(accepted)


def _huge(rate: float, mode: str) -> float:
    """Number of non-finite values in frames of bodies with rates near the limit of float32, after one unit."""
    fast = [
        model_of(kind, velocity=[rate, 0, 0], angular_velocity=[0, rate, 0], acceleration=[0, 0, rate])
        for kind in models.KINDS
    ]
    scene = scene_of([body() + [k, 0, 0] for k in range(len(fast))], [MotionModel()] * len(fast), singles=True)
    groups = [dataclasses.replace(g, model=m) for g, m in zip(scene.groups[1:], fast, strict=True)]
    assert scene.dynamics is not None
    states = np.full_like(scene.dynamics.rates, rate)
    scene = dataclasses.replace(scene.with_arrays(dynamics=states), groups=(scene.groups[0], *groups))
    with np.errstate(all="ignore"):
        frame = scene_player.frame(scene, T_MAX + 1, mode)
    return float((~np.isfinite(frame.means)).sum() + (~np.isfinite(frame.quats)).sum())


def _lacking(clouds: list[np.ndarray]) -> float:
    """Number of non-finite values and wrong shapes in all modes of an incomplete scene."""
    motions = list(MOTIONS.values())[1 : 1 + len(clouds)]
    scene, bad = scene_of(clouds, motions, singles=True), 0
    for mode in _EVERY_MODE:
        for t in (*_PAST, T_MAX, T_MAX + 1e-9, 1.0, 3.0):
            frame = scene_player.frame(scene, t, mode)
            bad += frame.means.shape != scene.gaussians.means.shape
            bad += int((~np.isfinite(frame.means)).sum() + (~np.isfinite(frame.quats)).sum())
    return float(bad)


def _before_first(mode: str) -> float:
    """Number of values that differ between frames at the first knot and long before it."""
    scene = every_motion(singles=True)
    first, long_ago = (scene_player.frame(scene, t, mode) for t in (0.0, -1e6))
    return different(first.means, long_ago.means) + different(first.quats, long_ago.quats)


_FLOAT32 = "rounding of float32"
_DISTANCE = "largest relative change of a distance"

CASES: tuple[Case, ...] = (
    *(
        Case(
            "distances in a body",
            f"{label} from the origin, to 100 times the observed time",
            "playback.scene_player.frame",
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
            "playback.scene_player.frame",
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
            "playback.scene_player.frame",
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
            "playback.scene_player.frame",
            "| |q| - 1 |",
            3e-7,
            _FLOAT32,
            functools.partial(_units, mode),
            functools.partial(_units, "rigid_paper") if mode == "rigid" else None,
        )
        for mode in _MODES
    ),
    *(
        Case(
            "t_max",
            f"the bind state to the bit, {mode}",
            "playback.scene_player.frame",
            "values that differ",
            0.0,
            "to the bit",
            functools.partial(_at_t_max, mode),
        )
        for mode in _EVERY_MODE
    ),
    *(
        Case(
            "t_max",
            f"no jump, {mode}",
            "playback.scene_player.frame",
            "distance / radius in 1e-9 units",
            1e-6,
            "rounding of float32 and speed",
            functools.partial(_jump, mode),
        )
        for mode in _EVERY_MODE
    ),
    Case(
        "t_max",
        "ten turns before and after it",
        "playback.scene_player.group_poses",
        "largest step of q / that of the turn",
        1 + 1e-3,
        "the track between its knots",
        _ten_turns,
    ),
    *(
        Case(
            "random access",
            f"shuffled times give the frames in order, {mode}",
            "playback.scene_player.frame",
            "values that differ",
            0.0,
            "to the bit",
            functools.partial(_random_access, mode),
        )
        for mode in _EVERY_MODE
    ),
    Case(
        "random access",
        "long before the first pose",
        "playback.scene_player.frame",
        "values that differ",
        0.0,
        "to the bit",
        functools.partial(_before_first, "rigid"),
    ),
    Case(
        "random access",
        "members with one twist move as their group",
        "playback.scene_player.frame",
        "distance / radius",
        2e-4,
        "residuals.TOLERANCE of the scene's extent",
        _agreement,
    ),
    *(
        case
        for label, value in (("NaN", math.nan), ("infinity", math.inf))
        for case in (
            Case(
                "bad rates",
                f"{label} in one group changes no other, rigid",
                "playback.scene_player.frame",
                "values of others that differ",
                0.0,
                "to the bit",
                functools.partial(_isolated, value),
            ),
            Case(
                "bad rates",
                f"{label} in one group: it stands still, standard",
                "playback.scene_player.frame",
                "values that differ from that",
                0.0,
                "to the bit",
                lambda value=value: _singles(value)[0],
            ),
            Case(
                "bad rates",
                f"{label} in one group: others move as before, standard",
                "playback.scene_player.frame",
                "distance / extent",
                2e-5,
                "twice residuals.TOLERANCE",
                lambda value=value: _singles(value)[1],
            ),
        )
    ),
    Case(
        "bad rates",
        "a motion model with NaN or infinity raises an error",
        "motion.models.MotionModel",
        "accepted",
        0.0,
        "an error is raised",
        _refused_rates,
    ),
    *(
        Case(
            "bad rates",
            f"rates of {rate:g}, {mode}",
            "playback.scene_player.frame",
            "values that are not finite",
            0.0,
            "all finite",
            functools.partial(_huge, rate, mode),
        )
        for rate in (1e30, 1e38)
        for mode in ("rigid", "standard")
    ),
    *(
        Case(
            "incomplete scenes",
            name,
            "playback.scene_player.frame",
            "values not finite, shapes wrong",
            0.0,
            "finite values, correct shapes",
            functools.partial(_lacking, clouds),
        )
        for name, clouds in (
            ("no Gaussians and no groups", []),
            ("a group without members", [body(), np.zeros((0, 3)), body() + 1]),
            ("one Gaussian in a group", [body()[:1], body()]),
            ("two Gaussians in a group", [body()[:2], body()]),
            ("a group of coincident points", [np.full((5, 3), 0.3), body()]),
            ("a group of collinear points", [np.outer(np.linspace(-1, 1, 9), [1.0, 0, 0]), body()]),
        )
    ),
)

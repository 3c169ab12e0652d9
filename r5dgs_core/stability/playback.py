"""Stability cases on playback: t_max, random access, bad rates, incomplete scenes."""

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
from .cases import RADIUS, Case, body, different, largest, model_of
from .scenes import EVERY_MODE, HORIZON, MOTIONS, PAST, T_MAX, every_motion, scene_of


def _at_t_max(mode: str) -> float:
    """Number of values of the frame at t_max that differ from the bind state."""
    scene = every_motion(singles=True)
    frame = scene_player.Player(scene, mode).frame(scene.t_max)
    return different(frame.means, scene.gaussians.means) + different(frame.quats, scene.gaussians.quats)


def _jump(mode: str) -> float:
    """Largest displacement of points from t_max to 1e-9 units before and after it, in radii."""
    scene = every_motion(singles=True)
    frames = [scene_player.Player(scene, mode).frame(scene.t_max + step) for step in (-1e-9, 0.0, 1e-9)]
    return max(largest(frame.means.astype(np.float64) - frames[1].means) for frame in frames) / RADIUS


def _random_access(mode: str) -> float:
    """Number of values that differ between frames of one player in shuffled order and frames of a new player each."""
    times = [*np.linspace(0, 3, 19).tolist(), 0.3, 3.0 if mode == "rigid_paper" else HORIZON]
    forward = [scene_player.Player(every_motion(singles=True), mode).frame(t) for t in times]
    player, count = scene_player.Player(every_motion(singles=True), mode), 0.0
    for i in np.random.default_rng(8).permutation(len(times)):
        frame = player.frame(times[i])
        count += different(frame.means, forward[i].means) + different(frame.quats, forward[i].quats)
    return count


def _agreement() -> float:
    """Largest difference between modes "standard" and "rigid" if all members share one twist, in radii."""
    scene, worst = every_motion(singles=True), 0.0
    rows = np.flatnonzero(scene.gaussians.motion_ids == list(MOTIONS).index("world twist") + 1)
    for t in (1.0, 2.0, 5.0):
        rigid, single = (
            scene_player.Player(scene, mode).frame(t).means[rows].astype(np.float64) for mode in ("rigid", "standard")
        )
        worst = max(worst, largest(rigid - single) / RADIUS)
    return worst


def _ten_turns() -> float:
    """Largest quaternion step over ten observed and ten extrapolated turns, relative to the expected step."""
    model = model_of("ballistic_spin", angular_velocity=[0, 0, 20 * math.pi / T_MAX])
    scene = scene_of([body()], [model], times=np.linspace(0, T_MAX, 181))
    times = np.linspace(0, 2 * T_MAX, 361)
    quats = np.stack([scene_player.Player(scene).group_poses(t)[0][1] for t in times])
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
    sound = {t: scene_player.Player(scene).frame(t) for t in (0.4, 2.0)}
    for g in range(1, len(scene.groups)):
        broken = _wild(_wild(scene, g, "velocity", value), g, "angular_velocity", value)
        poses = scene.tracks.poses.copy()
        poses[g, :-1, 1:] = value
        broken = broken.with_arrays(track_poses=poses)
        others = scene.gaussians.motion_ids != g
        for t, expected in sound.items():
            frame = scene_player.Player(broken).frame(t)
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
    sound = scene_player.Player(scene, "standard").frame(2.0)
    for g in range(1, len(scene.groups)):
        mine = scene.gaussians.motion_ids == g
        bad, still = (np.where(mine[:, None], np.float32(x), scene.dynamics.rates) for x in (value, 0.0))
        frame, expected = (
            scene_player.Player(scene.with_arrays(dynamics=states), "standard").frame(2.0) for states in (bad, still)
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
        frame = scene_player.Player(scene, mode).frame(T_MAX + 1)
    return float((~np.isfinite(frame.means)).sum() + (~np.isfinite(frame.quats)).sum())


def _lacking(clouds: list[np.ndarray]) -> float:
    """Number of non-finite values and wrong shapes in all modes of an incomplete scene."""
    motions = list(MOTIONS.values())[1 : 1 + len(clouds)]
    scene, bad = scene_of(clouds, motions, singles=True), 0
    for mode in EVERY_MODE:
        for t in (*PAST, T_MAX, T_MAX + 1e-9, 1.0, 3.0):
            frame = scene_player.Player(scene, mode).frame(t)
            bad += frame.means.shape != scene.gaussians.means.shape
            bad += int((~np.isfinite(frame.means)).sum() + (~np.isfinite(frame.quats)).sum())
    return float(bad)


def _before_first(mode: str) -> float:
    """Number of values that differ between frames at the first knot and long before it."""
    scene = every_motion(singles=True)
    first, long_ago = (scene_player.Player(scene, mode).frame(t) for t in (0.0, -1e6))
    return different(first.means, long_ago.means) + different(first.quats, long_ago.quats)


CASES: tuple[Case, ...] = (
    *(
        Case(
            "t_max",
            f"the bind state to the bit, {mode}",
            "playback.scene_player.Player.frame",
            "values that differ",
            0.0,
            "to the bit",
            functools.partial(_at_t_max, mode),
        )
        for mode in EVERY_MODE
    ),
    *(
        Case(
            "t_max",
            f"no jump, {mode}",
            "playback.scene_player.Player.frame",
            "distance / radius in 1e-9 units",
            1e-6,
            "rounding of float32 and speed",
            functools.partial(_jump, mode),
        )
        for mode in EVERY_MODE
    ),
    Case(
        "t_max",
        "ten turns before and after it",
        "playback.scene_player.Player.group_poses",
        "largest step of q / that of the turn",
        1 + 1e-3,
        "the track between its knots",
        _ten_turns,
    ),
    *(
        Case(
            "random access",
            f"shuffled times give the frames in order, {mode}",
            "playback.scene_player.Player.frame",
            "values that differ",
            0.0,
            "to the bit",
            functools.partial(_random_access, mode),
        )
        for mode in EVERY_MODE
    ),
    Case(
        "random access",
        "long before the first pose",
        "playback.scene_player.Player.frame",
        "values that differ",
        0.0,
        "to the bit",
        functools.partial(_before_first, "rigid"),
    ),
    Case(
        "random access",
        "members with one twist move as their group",
        "playback.scene_player.Player.frame",
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
                "playback.scene_player.Player.frame",
                "values of others that differ",
                0.0,
                "to the bit",
                functools.partial(_isolated, value),
            ),
            Case(
                "bad rates",
                f"{label} in one group: it stands still, standard",
                "playback.scene_player.Player.frame",
                "values that differ from that",
                0.0,
                "to the bit",
                lambda value=value: _singles(value)[0],
            ),
            Case(
                "bad rates",
                f"{label} in one group: others move as before, standard",
                "playback.scene_player.Player.frame",
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
            "playback.scene_player.Player.frame",
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
            "playback.scene_player.Player.frame",
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

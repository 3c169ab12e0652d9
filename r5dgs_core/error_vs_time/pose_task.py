"""Task "poses": predicted against true object poses, for group motions, motion models and the confidence band."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import timing
from ..data.dataset import GroundTruth
from ..evaluation import ground_truth_poses, metrics
from ..motion import models, rigid_fit, se3, torque_free_rotation
from ..motion.history import UNKNOWN_TURN, PoseErrors
from ..motion_fit import candidates, model_selection, noise, pose_weights
from ..playback import group_dynamics, modes, scene_player
from ..scene.scene import MotionGroup, Scene
from ..scene.world_axes import UP_AXIS
from .report_rows import Row, spread
from .task import Goal, Panel, Task, percent

MODELS = tuple(candidates.BY_NAME)  # fitted one at a time
ALONE = "for all objects"  # setting of a row of one model; the best of them is known only afterwards
CHOSEN = "chosen of the family"
STEADY = {"spring": "translation, quadratic", "pendulum": "hinge"}  # fallback of a model for objects that do not swing
_SAME = 1e-9  # tolerance for equal times
_MIN_MOMENT = 1e-6  # added to the inertia, which is singular for collinear members but must not be for a free top


@dataclass(frozen=True)
class FittedMethod:
    """One model fitted to every body.

    Attributes:
        fits: Fit of each body; None for an object at rest without a track of its own.
        ms: Processor time of the fits, milliseconds.
    """

    fits: tuple[model_selection.Fit | None, ...]
    ms: float


def measure(
    scene: Scene, ground_truth: GroundTruth | None, rounds: int, clock: str = "wall"
) -> tuple[list[Row], list[str]]:
    """Return the rows of the task "poses", at the last true time and along the horizon.

    Args:
        scene: The scene.
        ground_truth: True poses, or None if the data set has none.
        rounds: Timing rounds.
        clock: Clock of the rows' ``ms``, from `timing.CLOCKS`.

    Returns:
        The rows, and the reasons for missing measurements.
    """
    if ground_truth is None:
        return [], ["poses: no true poses are known (a data set has them in ground_truth.json), so no pose error"]
    bodies = ground_truth_poses.bodies(scene, ground_truth)
    later = ground_truth.times > scene.t_max + _SAME
    if not bodies or not later.any():
        why = "none of them lies past t_max" if bodies else "none of them belongs to an observed object of the scene"
        return [], [f"poses: the data set has true poses, but {why}"]
    rows, absent = _of_modes(scene, bodies, later, rounds, clock)
    some, missing = _of_models(scene, bodies, later, rounds, clock)
    return rows + some, absent + missing


def _of_modes(
    scene: Scene, bodies: tuple[ground_truth_poses.Body, ...], later: np.ndarray, rounds: int, clock: str
) -> tuple[list[Row], list[str]]:
    """Measure each playback mode except "hybrid", whose bodies move as in "rigid".

    If Gaussians move one by one, the pose of a body is the rigid fit to its Gaussians.
    """
    times = bodies[0].times[later]
    last = float(times[-1])
    players = {
        mode: scene_player.Player(scene, mode) for mode in scene_player.modes(scene) if not mode.startswith("hybrid")
    }
    calls: dict[str, Callable[[], object]] = {}
    for mode, player in players.items():
        by_groups = modes.split(mode)[0] == "rigid"
        calls[mode] = (lambda p=player: p.group_poses(last)) if by_groups else (lambda p=player: p.frame(last))
    timed = timing.take(calls, rounds)
    rows = []
    for mode, player in players.items():
        if modes.split(mode)[0] == "rigid":
            predicted, method, note = _group_motion(player, bodies, times), "group poses", ""
        else:
            predicted, method = _member_motion(scene, player, bodies, times), "rigid fit to moved Gaussians"
            note = "time is that of all Gaussians"
        label = {"task": "poses", "mode": mode, "method": method, "setting": "as baked", "note": note}
        rows += errors(scene, bodies, later, predicted, {**label, **timed[mode].columns(clock)})
    absent = []
    if len(players) == 1:
        absent.append("poses of rigid/representative, median, least_squares, kabsch, standard, rigid_paper: the scene "
                      "holds no dynamics of its Gaussians; a `field` run has them")  # fmt: skip
    else:
        absent.append("poses of hybrid: its bodies move as those of rigid")
    return rows, absent


def _of_models(
    scene: Scene, bodies: tuple[ground_truth_poses.Body, ...], later: np.ndarray, rounds: int, clock: str
) -> tuple[list[Row], list[str]]:
    """Measure each motion model alone, the selected one, and the confidence band that the scene stores."""
    times = bodies[0].times[later]
    taus = times - scene.t_max
    fitted = {name: fit_all(scene, bodies, (name, STEADY[name]) if name in STEADY else (name,)) for name in MODELS}
    chosen = fit_all(scene, bodies, None)
    counts = {name: sum(fit is not None and fit.chosen == name for fit in chosen.fits) for name in MODELS}
    found = {**fitted, CHOSEN: chosen}
    sets = {
        name: [model_of(body, fit) for body, fit in zip(bodies, some.fits, strict=True)] for name, some in found.items()
    }
    stacks = {name: models.MotionStack(some) for name, some in sets.items()}
    timed = timing.take({name: lambda s=stack: s.poses(float(taus[-1])) for name, stack in stacks.items()}, rounds)
    rows = []
    for name, some in found.items():
        predicted = np.stack([model_motion(b, m, taus) for b, m in zip(bodies, sets[name], strict=True)])
        count = counts.get(name)
        setting = "evidence, breaks" if count is None else ALONE
        rested = sum(fit is not None and fit.rested for fit in some.fits)
        notes = [f"chosen for {count} of {len(bodies)}"] if count else []
        notes += [f"{rested} found at rest"] if rested else []
        notes += [f"{STEADY[name]} if nothing swings"] if name in STEADY else []
        label = {"task": "poses", "mode": "rigid/fitted", "method": name, "setting": setting, "note": "; ".join(notes)}
        rows += errors(scene, bodies, later, predicted, {**label, **timed[name].columns(clock), "ms_once_cpu": some.ms})
    band, absent = _band(bodies, times, taus)
    return rows + band, absent


def fit_all(scene: Scene, bodies: tuple[ground_truth_poses.Body, ...], names: tuple[str, ...] | None) -> FittedMethod:
    """Fit the tracks of the bodies, choosing from ``names``; see `fit_group`."""
    started = time.process_time()
    fits = tuple(fit_group(scene, body.group, names) if body.group.role == "body" else None for body in bodies)
    return FittedMethod(fits, 1e3 * (time.process_time() - started))


def fit_group(scene: Scene, group: MotionGroup, names: tuple[str, ...] | None) -> model_selection.Fit:
    """Fit the track of a body with the stored errors of its poses and the up axis, as baking does.

    Rotations that the images do not determine are left out, also out of the confidence band. Unlike the motions of the
    scene file, this fit knows neither the joints of parts nor the gravity that falling bodies share. It follows
    rotation about a single unseen axis, and motion that baking has found to be noise but kept up to t_max.

    Args:
        scene: The scene.
        group: A motion group of role "body".
        names: Motion models to choose from, of `MODELS`; all if None.
    """
    track, errors = _track(scene, group)
    radius = group.model.radius
    first, last = group.seen or (-np.inf, np.inf)
    rows, _ = group_dynamics.opaque_members(scene, np.flatnonzero(scene.gaussians.motion_ids == group.id))
    # Only a free top needs the inertia, so it is computed only if that model is a candidate.
    shape = None
    if names is None or names == (candidates.FREE_TOP.name,):
        shape = torque_free_rotation.inertia(scene.gaussians.means[rows])
        shape = shape + _MIN_MOMENT * np.eye(3)
    seen = (scene.tracks.times >= first - _SAME) & (scene.tracks.times <= last + _SAME)
    turns = bool(np.any(track[:, 1:4] != 0))
    known = pose_weights.from_errors(errors, seen, radius, turns, group.rigid_rms)
    return model_selection.fit(
        scene.tracks.times,
        track[:, :4],
        track[:, 4:],
        radius=radius,
        weights=known.weights,
        candidates=names,
        inertia=shape,
        least_noise=noise.of_images(radius, *known.noise),
        drift=known.drift,
        up=UP_AXIS.get(scene.world_convention),
    )


def _track(scene: Scene, group: MotionGroup) -> tuple[np.ndarray, PoseErrors | None]:
    """Return the poses of a body [S, 7] and their errors, without its rotation if the images do not determine it.

    The centre of the body then moves as before, because the place of the pivot in the true body is unknown.
    """
    track, errors = scene.tracks.poses[group.id], group.history.errors
    if errors is None or not any(map(math.isfinite, errors.turn)):
        return track, errors
    if min(value for value in errors.turn if math.isfinite(value)) < UNKNOWN_TURN:
        return track, errors
    members = scene.gaussians.means[scene.gaussians.motion_ids == group.id].astype(np.float64)
    plain = se3.without_spin(track, np.eye(3), np.median(members, axis=0) - group.pivot)
    return plain, dataclasses.replace(errors, turn=tuple(np.where(np.isinf(errors.turn), np.inf, 0.0).tolist()))


def model_of(body: ground_truth_poses.Body, fit: model_selection.Fit | None) -> models.MotionModel:
    return models.MotionModel(radius=body.size / 2) if fit is None else fit.model


def model_motion(body: ground_truth_poses.Body, model: models.MotionModel, taus: np.ndarray) -> np.ndarray:
    """Return the motion of a body by a model at times past t_max. [H, 4, 4]"""
    quats, displacements = models.evaluate(model, taus)
    return np.stack([se3.pose_to_matrix(body.group.pivot, q, d) for q, d in zip(quats, displacements, strict=True)])


def _group_motion(
    player: scene_player.Player, bodies: tuple[ground_truth_poses.Body, ...], times: np.ndarray
) -> np.ndarray:
    """Return the motion of the bodies' groups in a mode. [B, H, 4, 4]"""
    found = [player.group_poses(float(t)) for t in times]
    groups = [body.group for body in bodies]
    return np.stack([np.stack([se3.pose_to_matrix(g.pivot, q[g.id], d[g.id]) for q, d in found]) for g in groups])


def _member_motion(
    scene: Scene, player: scene_player.Player, bodies: tuple[ground_truth_poses.Body, ...], times: np.ndarray
) -> np.ndarray:
    """Return the rigid motions that best fit the moved Gaussians of the bodies. [B, H, 4, 4]"""
    members = []
    for body in bodies:
        own = (scene.gaussians.object_ids == body.object_id) & (scene.gaussians.motion_ids == body.group.id)
        members.append(group_dynamics.opaque_members(scene, np.flatnonzero(own)))
    result = np.empty((len(bodies), len(times), 4, 4))
    for k, t in enumerate(times):
        means = player.frame(float(t)).means.astype(np.float64)
        for i, (body, (rows, weights)) in enumerate(zip(bodies, members, strict=True)):
            fit = rigid_fit.fit_rigid(scene.gaussians.means[rows].astype(np.float64), means[rows], weights)
            result[i, k] = se3.pose_to_matrix(body.group.pivot, fit.quat, fit.displacement_at(body.group.pivot))
    return result


def errors(
    scene: Scene,
    bodies: tuple[ground_truth_poses.Body, ...],
    later: np.ndarray,
    predicted: np.ndarray,
    shared: dict[str, Any],
) -> list[Row]:
    """Return rows of a prediction at the last time, and at the earlier times past t_max.

    Args:
        scene: The scene.
        bodies: Its bodies with true poses.
        later: Mask of the bodies' times past t_max. [S]
        predicted: Predicted motion. [B, H, 4, 4]
        shared: Other attributes of the rows.
    """
    names = [scene.object(body.object_id).name for body in bodies]
    pairs = [
        metrics.pose_errors(some, body.motion[later], body.group.pivot)
        for body, some in zip(bodies, predicted, strict=True)
    ]
    positions = np.stack([distance / body.size for body, (distance, _) in zip(bodies, pairs, strict=True)])  # [B, H]
    angles = np.stack([angle for _, angle in pairs])
    times = bodies[0].times[later]
    rows = []
    for k in reversed(range(len(times))):
        at = "" if k == len(times) - 1 else f"@t={times[k]:.4g}"
        rows += [
            Row(error_kind=f"position{at}", **spread(positions[:, k], names=names), count=len(bodies), **shared),
            Row(error_kind=f"rotation{at}", **spread(angles[:, k], names=names), count=len(bodies), **shared),
        ]
    return rows


def _band(
    bodies: tuple[ground_truth_poses.Body, ...], times: np.ndarray, taus: np.ndarray
) -> tuple[list[Row], list[str]]:
    """Return the share of errors of the stored motions outside their stored 95 % bands, over bodies and times.

    Only times up to the last knot of a band count. The error of a body is the RMS over a sphere of its radius:
    |dd|^2 + 2/3 (dtheta radius)^2. If the images do not determine the rotation of the body, it is the position error.
    """
    inside, count, widths = 0, 0, []
    for body in bodies:
        band, model = body.group.history.band, body.group.model
        if band is None:
            continue
        reached = times <= band.times[-1] + _SAME
        truth = body.motion[np.isin(body.times, times)]
        distances, angles = metrics.pose_errors(model_motion(body, model, taus), truth, body.group.pivot)
        if not body.turn_seen:  # then neither its rotation nor the pivot's place in the true body is known
            places = body.group.pivot + models.evaluate(model, taus)[1]
            distances, angles = np.linalg.norm(places - body.path[np.isin(body.times, times)], axis=-1), 0.0 * angles
        errors = np.sqrt(distances**2 + 2 / 3 * (np.radians(angles) * model.radius) ** 2)
        half = band.widths(times)
        inside += int((errors <= half)[reached].sum())
        count += int(reached.sum())
        widths.append(float(half[reached][-1]) / body.size if reached.any() else np.nan)
    if count == 0:
        return [], ["poses: the scene stores no confidence band that reaches the times of the truth"]
    width = f"; median half width at the last time {np.nanmedian(widths):.3g} of the size"
    row = Row(
        task="poses",
        mode="rigid/fitted",
        method="outside 95 % band",
        setting="as baked",
        error_kind="outside_band",
        error=1 - inside / count,
        count=count,
        note=f"{inside} of {count} errors inside (bodies x times){width}",
    )
    return [row], []


TASK = Task(
    "poses",
    "Poses: predicted object poses at the last time against the truth",
    lambda request: measure(request.scene, request.data.ground_truth, request.rounds, request.clock),
    Panel(
        "position",
        "position error, % of the object's size",
        lambda row, scene: f"Predicted poses of {row.count} objects at the last time: median error against the truth",
        lambda row: row.method if row.mode == "rigid/fitted" else f"mode {row.mode}",
        floor=1e-4,
        factor=100.0,
    ),
    Goal(
        "position",
        1e-3,
        percent,
        lambda row: f"{row.mode}, {row.method}",
        worst_object=True,
        selectable=lambda row: row.setting != ALONE,
    ),
    needs_data=True,
    over_objects=True,
)

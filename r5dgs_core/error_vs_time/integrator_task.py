"""Task "dynamics": error and time of integrators past t_max, against a fine reference.

Notation: K moving groups, P Gaussians in them; tau the time past t_max. The state of a group at t_max is a twist (w, v)
about its pivot with rates (eps, a). The integrators follow that twist, which changes linearly with time. A fitted model
in closed form is compared with a fine integration of its own rates. The position error is the largest over the pivot
and six points at the group's radius, as a share of its diameter.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from .. import timing
from ..motion import models, point_dynamics, rotations, se3, twist_propagation
from ..playback import residuals
from ..scene.scene import MotionGroup, Scene
from .report_rows import Row, spread
from .task import Goal, Panel, Task, method_and_setting, percent

STEPS = (1, 2, 4, 8, 16, 32, 64)
FINE_STEPS = 4096
POINT_STEPS = (1, 4, 15, 60)  # for single Gaussians; few settings, because there are many Gaussians
FINE_POINT_STEPS = 256
POINTS_AT_ONCE = 512  # Gaussians per batch of the reference
ROUNDING = 1e-15  # errors below this are rounding errors
TWIST = "world twist"
_CORNERS = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
Poses = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _State:
    """States of K groups at t_max about their pivots.

    Attributes:
        v: Velocities of the pivots. [K, 3]
        w: Angular velocities. [K, 3]
        a: Accelerations. [K, 3]
        eps: Angular accelerations. [K, 3]
        radii: Radii of the groups. [K]
    """

    v: np.ndarray
    w: np.ndarray
    a: np.ndarray
    eps: np.ndarray
    radii: np.ndarray


def measure(scene: Scene, tau: float, rounds: int, clock: str = "wall") -> tuple[list[Row], list[str]]:
    """Return the rows of the task "dynamics".

    Args:
        scene: The scene.
        tau: Time past t_max at which errors are measured.
        rounds: Timing rounds.
        clock: Clock of the rows' ``ms``, from `timing.CLOCKS`.

    Returns:
        The rows, and the reasons for missing measurements.
    """
    groups = [g for g in scene.groups if g.role == "body" and g.follows is None and _moves(g)]
    absent = []
    if not groups:
        absent.append("dynamics: no group of the scene moves past t_max, so there is nothing to integrate")
    rows = _of_groups(scene, groups, tau, rounds, clock) if groups else []
    if scene.dynamics is None:
        absent.append("dynamics of single Gaussians (mode standard): the scene holds none; a `field` run has them")
    elif not (scene.dynamics.rates != 0).any():
        absent.append("dynamics of single Gaussians (mode standard): all Gaussians of the scene rest")
    else:
        rows += _of_points(scene, tau, rounds, clock)
    return rows, absent


def state_of(model: models.MotionModel) -> np.ndarray:
    """Return the twist of a model at t_max about its pivot, and its rates: v, w, a, eps. [4, 3]

    Taken from the fitted curve, without the faded offset.
    """
    step = 1e-3 * model.fade_time
    _, _, spins, velocities = models.curve(model, np.array([-step, 0.0, step]))
    v, w = velocities[1], spins[1]
    # The pivot's acceleration is a + eps x 0 + w x v.
    a = (velocities[2] - velocities[0]) / (2 * step) - np.cross(w, v)
    eps = (spins[2] - spins[0]) / (2 * step)
    return np.stack([v, w, a, eps])


@contextmanager
def _unwarned() -> Iterator[None]:
    """Silence the warning about long steps, whose effect is measured here."""
    log = logging.getLogger(point_dynamics.__name__)
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


def _moves(group: MotionGroup) -> bool:
    return not _without_offset(group.model).is_static


def _without_offset(model: models.MotionModel) -> models.MotionModel:
    return dataclasses.replace(model, offset_rotvec=np.zeros(3), offset_displacement=np.zeros(3))


def _of_groups(scene: Scene, groups: list[MotionGroup], tau: float, rounds: int, clock: str) -> list[Row]:
    plain = [_without_offset(group.model) for group in groups]
    v, w, a, eps = np.stack([state_of(model) for model in plain], axis=1)
    state = _State(v, w, a, eps, np.array([model.radius for model in plain]))
    twists = [
        models.MotionModel("world_twist", v[k], a[k], w[k], eps[k], radius=state.radii[k]) for k in range(len(plain))
    ]
    spans = np.full(len(plain), tau)
    arms, owners = _members(scene, groups)
    reference = se3.integrate(w, v, eps, a, spans, FINE_STEPS)
    fine_models = _fine(plain, tau)

    calls: dict[tuple[str, str, str], Callable[[], Poses]] = {}
    for steps in STEPS:
        setting = f"{steps} step{'s' * (steps > 1)}"
        for order in (2, 4):
            calls[TWIST, f"Magnus-{order}", setting] = lambda n=steps, o=order: se3.integrate(w, v, eps, a, spans, n, o)
        calls[TWIST, "trace_rk2, per group", setting] = lambda n=steps: point_dynamics.rk2(
            0 * v, v, w, a, eps, tau, abs(tau) / n
        )[::-1]
        each = (v[owners], w[owners], a[owners], eps[owners])
        calls[TWIST, "trace_rk2, per Gaussian", setting] = lambda n=steps, each=each: point_dynamics.rk2(
            arms, *each, tau, abs(tau) / n
        )[::-1]
    calls[TWIST, "Magnus-4", "step rule"] = lambda: models.evaluate_all(twists, tau)
    calls["rigid/fitted", "closed form", "exact"] = lambda: models.evaluate_all(plain, tau)
    with _unwarned():
        times = timing.take(calls, rounds)
        found = {key: call() for key, call in calls.items()}

    rows, notes = [], {TWIST: f"{len(groups)} groups", "rigid/fitted": f"{len(groups)} groups, against its own motion"}
    for (mode, method, setting), poses in found.items():
        truth = fine_models if mode == "rigid/fitted" else reference
        if method == "trace_rk2, per Gaussian":
            steps = int(setting.split()[0])
            with _unwarned():
                positions, angles = _point_errors(state, reference, tau, steps)
            note = f"{len(arms)} Gaussians"
        else:
            positions, angles = _pose_errors(state.radii, poses, truth)
            note = notes[mode]
        label = {"task": "dynamics", "mode": mode, "method": method, "setting": setting, "note": note}
        shared = {**label, **times[mode, method, setting].columns(clock), "count": len(groups)}
        rows += [
            Row(error_kind="position", **spread(positions), **shared),
            Row(error_kind="rotation", **spread(angles), **shared),
        ]
    return rows


def _members(scene: Scene, groups: list[MotionGroup]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of the groups' Gaussians relative to their pivots [P, 3], and the group index of each [P]."""
    rows = [np.flatnonzero(scene.gaussians.motion_ids == group.id) for group in groups]
    pairs = zip(groups, rows, strict=True)
    arms = [scene.gaussians.means[some].astype(np.float64) - group.pivot for group, some in pairs]
    return np.concatenate(arms), np.repeat(np.arange(len(groups)), [len(some) for some in rows])


def _fine(plain: list[models.MotionModel], tau: float) -> Poses:
    """Integrate models by small Magnus-4 steps of their own rates, independently of any closed form.

    With the twists x1, x2 about the pivot at the Gauss nodes of a step h the exponent is
    h (x1 + x2)/2 - sqrt(3)/12 h^2 [x1, x2].
    """
    h = tau / FINE_STEPS
    starts = h * np.arange(FINE_STEPS)
    nodes = [starts + h * (0.5 + sign * math.sqrt(3) / 6) for sign in (-1, 1)]
    quats, displacements = [], []
    for model in plain:
        twists = []
        for at in nodes:
            _, d, spins, velocities = models.curve(model, at)
            twists.append((spins, velocities - np.cross(spins, d)))
        (w1, v1), (w2, v2) = twists
        bracket = np.cross(w1, w2), np.cross(w1, v2) - np.cross(w2, v1)
        scale = math.sqrt(3) / 12 * h**2
        exponents = 0.5 * h * (w1 + w2) - scale * bracket[0], 0.5 * h * (v1 + v2) - scale * bracket[1]
        q, d = se3.product(*se3.exp(*exponents))
        quats.append(rotations.normalize(q))
        displacements.append(d)
    return np.stack(quats), np.stack(displacements)


def _pose_errors(radii: np.ndarray, poses: Poses, truth: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return position errors as shares of the diameter [K], and rotation errors in degrees [K]."""
    points = radii[:, None, None] * _CORNERS  # [K, 7, 3]
    moved, expected = (rotations.rotate(q[:, None], points) + d[:, None] for q, d in (poses, truth))
    distances = np.linalg.norm(moved - expected, axis=-1).max(axis=-1)
    return distances / (2 * radii), np.degrees(rotations.angle_between(poses[0], truth[0]))


def _point_errors(state: _State, truth: Poses, tau: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return errors as in `_pose_errors`, for points that are integrated one by one and may drift apart."""
    points = state.radii[:, None, None] * _CORNERS
    v, w, a, eps = (x[:, None] + 0 * points for x in (state.v, state.w, state.a, state.eps))
    moved, quats = point_dynamics.rk2(points, v, w, a, eps, tau, abs(tau) / steps)
    expected = rotations.rotate(truth[0][:, None], points) + truth[1][:, None]
    distances = np.linalg.norm(moved - expected, axis=-1).max(axis=-1)
    return distances / (2 * state.radii), np.degrees(rotations.angle_between(quats[:, 0], truth[0]))


def _of_points(scene: Scene, tau: float, rounds: int, clock: str) -> list[Row]:
    """Return rows for single Gaussians with their own dynamics: TRACE's integrator and ours."""
    assert scene.dynamics is not None
    moving = scene.dynamics.rates[(scene.dynamics.rates != 0).any(-1)].astype(np.float64)
    v, w, a, eps = np.split(moving, 4, axis=-1)
    fine_quats, fine = np.empty((len(moving), 4)), np.empty((len(moving), 3))
    for start in range(0, len(moving), POINTS_AT_ONCE):
        part = slice(start, start + POINTS_AT_ONCE)
        spans = np.full(len(moving[part]), tau)
        fine_quats[part], fine[part] = se3.integrate(w[part], v[part], eps[part], a[part], spans, FINE_POINT_STEPS)
    propagator = twist_propagation.Propagator(moving, residuals.TOLERANCE * scene.extent)
    calls: dict[tuple[str, str], Callable[[], Poses]] = {
        ("trace_rk2, own dynamics", f"{n} step{'s' * (n > 1)}"): lambda n=n: point_dynamics.rk2(
            0 * v, v, w, a, eps, tau, abs(tau) / n
        )[::-1]
        for n in POINT_STEPS
    }
    calls["Magnus-4, own dynamics", "step rule"] = lambda: propagator.rows_of(tau)
    with _unwarned():
        times = timing.take(calls, rounds)
        found = {key: call() for key, call in calls.items()}
    bodies = [2 * group.model.radius for group in scene.groups if group.role == "body"]
    size = float(np.median(bodies)) if bodies else scene.extent
    rows = []
    for (method, setting), (quats, displacements) in found.items():
        shared = {
            "task": "dynamics",
            "mode": "standard",
            "method": method,
            "setting": setting,
            "count": len(moving),
            "note": f"{len(moving)} Gaussians; size is the median of the groups'",
            **times[method, setting].columns(clock),
        }
        distances = np.linalg.norm(displacements - fine, axis=-1) / size
        angles = np.degrees(rotations.angle_between(quats, fine_quats))
        rows += [
            Row(error_kind="position", **spread(distances), **shared),
            Row(error_kind="rotation", **spread(angles), **shared),
        ]
    return rows


def _line_name(series: tuple[str, str]) -> str:
    mode, method = series
    return f"{method}, fitted model" if mode == "rigid/fitted" else method


TASK = Task(
    "dynamics",
    "Dynamics: integrators against a fine reference",
    lambda request: measure(request.scene, request.tau, request.rounds, request.clock),
    Panel(
        "position",
        "position error, % of the object's size",
        lambda row, scene: (
            f"Integrating {row.count} groups to {scene['horizon']['tau']:.3g} past t_max: error against a "
            "fine reference (numbers: steps)"
        ),
        lambda row: row.setting.removesuffix(" steps").removesuffix(" step"),
        floor=1e-13,
        factor=100.0,
        series=lambda row: (row.mode, row.method),
        in_line=lambda row: row.setting.endswith(("step", "steps")),
        line_name=_line_name,
        label_size=7,
    ),
    Goal("position", 1e-4, percent, method_and_setting),
    over_objects=True,
)

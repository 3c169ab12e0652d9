"""Stability cases on groups: degenerate bodies, twists of members, missing and aliased poses."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..motion import models, rigid_fit, rotations
from ..motion_fit import model_selection
from ..playback import group_dynamics
from .cases import ROUNDING, Case, angle, largest, logged, model_of
from .scenes import DIAGONAL, T_MAX, TIMES, scene_of

_SIGMA = 0.003  # noise of each point, half a percent of the body's length
_TURN = np.array([0.4, -0.9, 0.6])  # rad
_MOVE = np.array([0.3, -0.1, 0.2])
_LENGTH = 0.6
_FITS = 100


def _cloud(shape: str, rng: np.random.Generator) -> np.ndarray:
    """Points of a body of length 0.6; the shape sets its width. [n, 3]"""
    if shape in ("3 points", "2 points", "1 point"):
        return np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.25, 0.1]])[: int(shape[0])] * [1, 1, 1]
    widths = {"box": (0.4, 0.3), "plane": (0.4, 0.0), "rod 0.1": (0.06, 0.06), "rod 0.01": (0.006, 0.006)}
    width = np.array([_LENGTH, *widths.get(shape, (0.0, 0.0))])
    return rng.uniform(-0.5, 0.5, size=(400 if width[1] else 40, 3)) * width


def _fits(shape: str) -> list[tuple[np.ndarray, rigid_fit.RigidFit]]:
    """Fits to noisy copies of a cloud, each moved by a random true rotation, unit wxyz [4], and a translation.

    Random orientations are tested, because a naive fit mirrors a flat body only in some orientations.
    """
    rng, found = np.random.default_rng(6), []
    cloud = _cloud(shape, rng)
    for _ in range(_FITS):
        quat = rotations.normalize(rng.normal(size=4))
        target = rotations.rotate(quat, cloud) + _MOVE + _SIGMA * rng.normal(size=cloud.shape)
        found.append((quat, rigid_fit.fit_rigid(cloud, target)))
    return found


def _calibration(shape: str) -> float:
    """Relative difference between the rotation errors and those that the covariance predicts."""
    scores = []
    for quat, fit in _fits(shape):
        error = rotations.quats_to_rotvecs(rotations.multiply(rotations.conjugate(quat), fit.quat))
        scores.append(error @ np.linalg.solve(fit.rotation_covariance, error) / 3)
    return abs(math.sqrt(float(np.mean(scores))) - 1)


def _misfits(shape: str) -> float:
    """Number of fits with a point more than 8 sigma off, from mirroring or a wrong rotation."""
    cloud, wrong = _cloud(shape, np.random.default_rng(6)), 0
    for quat, fit in _fits(shape):
        fitted = cloud + fit.displacement_at(cloud)
        wrong += largest(fitted - rotations.rotate(quat, cloud) - _MOVE) > 8 * _SIGMA
    return float(wrong)


def _direction(shape: str) -> float:
    """Largest error of the direction of a line, rad; infinity if the rotation about the line is not minimal."""
    along, worst = np.array([1.0, 0, 0]), 0.0
    for quat, fit in _fits(shape):
        direction = rotations.rotate(fit.quat, along)
        worst = max(worst, float(np.linalg.norm(direction - rotations.rotate(quat, along))))
        least = rotations.between_vectors(along, direction)
        if len(fit.undetermined_axes) != 1 or angle(fit.quat, least) > 1e-9:
            return math.inf
    return worst


def _point(count: int) -> float:
    """Error of the fit to coincident points, whose rotation must be the hint: angle (rad) plus distance."""
    hint = rotations.rotvecs_to_quats(_TURN)
    cloud = np.tile([[0.2, 0.1, -0.3]], (count, 1))
    fit = rigid_fit.fit_rigid(cloud, cloud + _MOVE, hint=hint)
    return angle(fit.quat, hint) + float(np.linalg.norm(fit.displacement - _MOVE))


def _triangle() -> float:
    """Error of the fit to three exact points rotated by almost 180 degrees, rad."""
    quat = rotations.rotvecs_to_quats(_TURN / np.linalg.norm(_TURN) * (math.pi - 1e-6))
    cloud = _cloud("3 points", np.random.default_rng(0))
    return angle(rigid_fit.fit_rigid(cloud, rotations.rotate(quat, cloud) + _MOVE).quat, quat)


def _refused_fits() -> float:
    """Number of invalid inputs (no points, zero weights, NaN, infinity) that are accepted."""
    cloud = _cloud("3 points", np.random.default_rng(0))
    broken = cloud + np.array([[np.nan, 0, 0], [0, 0, 0], [0, 0, 0]])
    accepted = 0
    for source, target, weights in (
        (cloud[:0], cloud[:0], None),
        (cloud, cloud, np.zeros(3)),
        (broken, cloud, None),
        (cloud, np.where(np.isnan(broken), np.inf, broken), None),
    ):
        try:
            rigid_fit.fit_rigid(source, target, weights)
            accepted += 1
        except ValueError:
            pass
    return float(accepted)


_MEMBERS = 400
_DRIFTING = model_of("world_twist", velocity=[0.3, -0.2, 0.1], angular_velocity=[0.5, 1, -0.7])


def _aggregated(distance: float, source: str) -> np.ndarray:
    """Velocity of a body's centre and its spin, computed from noisy member twists, 10 % of them wrong. [6]

    The members lie on a grid that float32 represents exactly at every distance, which excludes rounding of the scene.
    """
    rng = np.random.default_rng(7)
    grid = np.round(rng.uniform(-0.25, 0.25, size=(_MEMBERS, 3)) * 512) / 512
    center = np.round(distance * np.array([0.75, -0.5, 0.5]) * 512) / 512
    scene = scene_of([grid + center], [_DRIFTING], singles=True)
    assert scene.dynamics is not None
    spins = _DRIFTING.angular_velocity + 0.2 * rng.normal(size=(_MEMBERS, 3))
    # Each member has the correct velocity at its own position, with any spin w_i.
    speeds = _DRIFTING.velocity + np.cross(_DRIFTING.angular_velocity, grid - grid.mean(0))
    speeds += 0.02 * rng.normal(size=(_MEMBERS, 3))
    wrong = rng.permutation(_MEMBERS)[: _MEMBERS // 10]
    speeds[wrong] += rng.normal(size=(len(wrong), 3)) + 1.0
    states = np.concatenate([speeds, spins, np.zeros((_MEMBERS, 6))], axis=-1).astype(np.float32)
    scene = scene.with_arrays(dynamics=states)
    model = group_dynamics.models_of(scene, source)[1]
    return np.concatenate([model.velocity, model.angular_velocity])


def _aggregation_error(distance: float, source: str) -> float:
    return float(np.linalg.norm(_aggregated(distance, source)[:3] - _DRIFTING.velocity))


def _aggregation_shift(source: str) -> float:
    near = _aggregated(0.0, source)
    return max(float(np.abs(_aggregated(d, source) - near).max()) for d in (1.0, 1e2, 1e4))


def _track(step_rad: float) -> tuple[np.ndarray, np.ndarray]:
    turns = step_rad * np.arange(len(TIMES))[:, None] * np.array([0.36, 0.48, -0.8])
    quats = rotations.rotvecs_to_quats(turns - turns[-1])
    return quats, np.zeros((len(TIMES), 3))


def _aliased(step_degrees: float, seen_degrees: float | None) -> float:
    """Error of the reported step, rad; infinity if a step is reported that should not be, or not reported."""
    found = rigid_fit.aliased_step(TIMES, _track(math.radians(step_degrees))[0])
    if found is None or seen_degrees is None:
        return 0.0 if found is None and seen_degrees is None else math.inf
    return abs(found[0] - math.radians(seen_degrees))


def _spin_of_track(step_degrees: float) -> float:
    """Relative error of the spin fitted to exact poses with steps of this size."""
    with logged():
        fit = model_selection.fit(TIMES, *_track(math.radians(step_degrees)), radius=0.3)
    expected = math.radians(step_degrees) / (T_MAX / (len(TIMES) - 1))
    return abs(float(np.linalg.norm(fit.model.angular_velocity)) / expected - 1)


def _few_poses() -> float:
    """Largest error, in radii, of motions fitted to 1, 2 and 3 poses, a quarter of their span past the last pose."""
    worst = 0.0
    for count, speed in ((1, 0.0), (2, 0.4), (3, 0.4)):
        times = TIMES[-count:]
        path = speed * (times - times[-1])[:, None] * DIAGONAL
        fit = model_selection.fit(times, rotations.identity(count), path, radius=0.3)
        _, displacement = models.evaluate(fit.model, 0.25 * (times[-1] - times[0]))
        expected = speed * 0.25 * (times[-1] - times[0]) * DIAGONAL
        worst = max(worst, largest((displacement - expected)[None]) / 0.3)
    return worst


_NOISE = "noise of half a percent, 100 fits"

CASES: tuple[Case, ...] = (
    *(
        Case(
            "degenerate groups",
            f"{shape}: errors match their prediction",
            "motion.rigid_fit.fit_rigid",
            "|rms error / predicted - 1|",
            0.2,
            _NOISE,
            functools.partial(_calibration, shape),
        )
        for shape in ("box", "plane", "rod 0.1", "rod 0.01")
    ),
    *(
        Case(
            "degenerate groups",
            f"{shape}: all points within 8 sigma",
            "motion.rigid_fit.fit_rigid",
            "fits with a point over 8 sigma off",
            0.0,
            _NOISE,
            functools.partial(_misfits, shape),
        )
        for shape in ("box", "plane", "rod 0.1", "rod 0.01", "line", "3 points", "2 points", "1 point")
    ),
    *(
        Case(
            "degenerate groups",
            f"{shape}: direction correct, rotation about it minimal",
            "motion.rigid_fit.fit_rigid",
            "largest error (rad)",
            tolerance,
            "5 sigma of the noise",
            functools.partial(_direction, shape),
        )
        for shape, tolerance in (("line", 0.015), ("2 points", 0.036))
    ),
    Case(
        "degenerate groups",
        "3 exact points, almost a half turn",
        "motion.rigid_fit.fit_rigid",
        "angle (rad)",
        1e-12,
        ROUNDING,
        _triangle,
    ),
    *(
        Case(
            "degenerate groups",
            f"{name}: rotation of the hint, exact displacement",
            "motion.rigid_fit.fit_rigid",
            "angle (rad) and distance",
            1e-14,
            ROUNDING,
            functools.partial(_point, count),
        )
        for name, count in (("1 point", 1), ("20 points in one place", 20))
    ),
    Case(
        "degenerate groups",
        "no points, zero weights, NaN, infinity raise errors",
        "motion.rigid_fit.fit_rigid",
        "accepted",
        0.0,
        "an error is raised",
        _refused_fits,
    ),
    *(
        Case(
            "twists of members",
            f"median of 400, 10 % of them wrong, {label} from the origin",
            "playback.group_dynamics.models_of",
            "error of the centre's velocity",
            0.015,
            "bias of the median from 10 % one-sided outliers, 0.14 sigma",
            functools.partial(_aggregation_error, d, "median"),
        )
        for label, d in (("0", 0.0), ("10", 10.0), ("1e4", 1e4))
    ),
    *(
        Case(
            "twists of members",
            f"{source.replace('_', ' ')}: the same 1, 100 and 1e4 from the origin",
            "playback.group_dynamics.models_of",
            "change of the twist",
            1e-10,
            ROUNDING,
            functools.partial(_aggregation_shift, source),
        )
        for source in ("representative", "median", "least_squares", "kabsch")
    ),
    *(
        Case(
            "aliasing",
            f"poses {step:g} degrees apart are {'reported' if seen else 'not reported'}",
            "motion.rigid_fit.aliased_step",
            "error of the reported step (rad)",
            1e-12,
            "steps over 120 degrees are reported; x > 180 degrees appears as 360 - x",
            functools.partial(_aliased, step, seen),
        )
        for step, seen in ((60.0, None), (119.0, None), (121.0, 121.0), (200.0, 160.0))
    ),
    Case(
        "aliasing",
        "spin of poses 100 degrees apart",
        "motion_fit.model_selection.fit",
        "relative error of the spin",
        1e-6,
        "exact poses",
        functools.partial(_spin_of_track, 100.0),
    ),
    Case(
        "few poses",
        "1, 2 and 3 poses",
        "motion_fit.model_selection.fit",
        "error / radius",
        1e-2,
        "linear motion is fitted exactly",
        _few_poses,
    ),
)

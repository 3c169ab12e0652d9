"""Search for the joint between two bodies, from their observed poses.

Each kind of joint is fitted to the motion of one body relative to the other. The kinds compete with each other and with
free motion by a Bayesian information criterion: a joint leaves fewer coordinates open at each time, but must explain
the others within the noise. Errors of single poses are capped, so that a few slipped poses do not hide a joint.

Notation: S poses; (Q, D) is the relative motion about a reference point c, x -> c + Q (x - c) + D, the identity at
t_max.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import joint as joints
from ..motion import robust_weights, rotations, se3
from ..motion.history import Band, History
from ..motion.joint import BALL, HINGE, SLIDER, Joint
from ..motion.pose_track import PoseTrack
from . import band as bands
from . import model_selection, noise

FARTHEST = 2.5  # maximum distance of a hinge or a ball from the centres of both bodies, in their radii
MIN_RANGE = 4.0  # minimum range of the coordinate, in units of its noise
SLACK = 0.05  # part of the range by which a prediction may exceed a limit
_BOTH = math.sqrt(2.0)  # the pose at t_max is as noisy as the others
_ROUNDS = 4  # reweighting rounds
_MISFIT = 2.0  # maximum median of the squared errors of poses, relative to the expected one
_CAP = 2.0  # maximum counted squared error of a pose, relative to the cost of a free pose
_HORIZON = 3.0  # time past t_max within which limits are respected, in observed spans


@dataclass(frozen=True)
class Link:
    """One of two bodies.

    Attributes:
        quats: Rotations relative to the bind state, unit wxyz. [S, 4]
        displacements: Displacements of the pivot. [S, 3]
        pivot: World. [3]
        radius: World units.
    """

    quats: np.ndarray
    displacements: np.ndarray
    pivot: np.ndarray
    radius: float


@dataclass(frozen=True)
class Found:
    """A joint and the evidence for it.

    Attributes:
        joint: The joint.
        cost: Bayesian information criterion relative to that of free motion, < 0.
        place_error: Root mean square distance of the child's pivot from the closed joint, world units.
        turn_error: The same for its rotation, rad.
        history: Events of the relative motion, and its confidence band.
    """

    joint: Joint
    cost: float
    place_error: float
    turn_error: float
    history: History


@dataclass(frozen=True)
class _RelativeMotion:
    """Motion of the child relative to the parent, about c.

    Attributes:
        poses: Q and D. [S, 4], [S, 3]
        weights: Confidence of the poses. [S]
        c: Reference point, the child's pivot. [3]
        middle: Middle of both pivots. [3]
        sigmas: Noise of displacements, world units, and rotations, rad.
    """

    poses: se3.Pose
    weights: np.ndarray
    c: np.ndarray
    middle: np.ndarray
    sigmas: tuple[float, float]

    def squares(self, closed: se3.Pose) -> np.ndarray:
        """Return the squared errors of the poses from closed ones, in units of the noise. [S]"""
        return (se3.differences(self.poses, closed, *self.sigmas) ** 2).sum(-1)

    def reweighted(self, closed: se3.Pose, count: int) -> np.ndarray:
        """Return robust weights of errors from closed poses that have ``count`` components. [S]"""
        return self.weights * robust_weights.cauchy_weights(self.squares(closed), 4.0 * count)


@dataclass(frozen=True)
class _Trial:
    """Kind of joint fitted to the relative motion.

    Attributes:
        kind: Kind of the joint.
        point: Point of the joint. [3]
        axis: Its axis, or None. [3]
        closed: Poses of the closed joint, about c. [S, 4], [S, 3]
        coordinates: Angle or distance at each time; empty for a ball. [S]
        parameters: Number of free parameters.
    """

    kind: str
    point: np.ndarray
    axis: np.ndarray | None
    closed: se3.Pose
    coordinates: np.ndarray
    parameters: int


def find(
    times: np.ndarray,
    parent: Link,
    child: Link,
    *,
    weights: np.ndarray | None = None,
    least_noise: tuple[float, float] = (0.0, 0.0),
) -> Found | None:
    """Find the joint between two bodies.

    Args:
        times: Increasing; the last is t_max. [S]
        parent: The body that carries the other.
        child: The other body.
        weights: Confidence of each pair of poses, >= 0; 0 excludes it. None for equal weights. [S]
        least_noise: Lower bounds of the noise of relative displacements, world units, and rotations, rad.

    Returns:
        The joint; None if free motion explains the poses better, or if they hardly move relative to each other.

    Source: own method.
    """
    weights = np.ones(len(times)) if weights is None else np.asarray(weights, np.float64)
    used = weights > 0
    if used.sum() < 4:
        return None
    c = np.asarray(child.pivot, np.float64)
    poses = [(np.asarray(x.quats, np.float64), np.asarray(x.displacements, np.float64)) for x in (parent, child)]
    quats, moves = joints.relative(poses[0], parent.pivot, poses[1], child.pivot, c)
    quats = rotations.make_continuous(quats[::-1])[::-1]
    sigmas = _noise(times[used], quats[used], moves[used], child.radius, least_noise)
    motion = _RelativeMotion((quats, moves), weights, c, 0.5 * (c + parent.pivot), sigmas)
    best, least = None, 0.0
    price = math.log(6.0 * used.sum())
    for fit in (_hinge, _ball, _slider):
        trial = fit(motion)
        squares = motion.squares(trial.closed)[used]
        freed = 6 - (3 if trial.kind == BALL else 1)
        cost = float(np.minimum(squares, _CAP * freed * price).sum()) + price * (trial.parameters - 6 * used.sum())
        if (
            cost < least
            and np.median(squares) <= _MISFIT * freed
            and _near(trial, parent, child)
            and _moves(trial, sigmas)
        ):
            best, least = trial, cost
    return None if best is None else _result(times, best, least, motion, child)


def _noise(
    times: np.ndarray, quats: np.ndarray, moves: np.ndarray, radius: float, least: tuple[float, float]
) -> tuple[float, float]:
    """Standard deviations of relative displacements and rotations, including those of the pose at t_max."""
    track = PoseTrack((times - times[-1]) / (times[-1] - times[0]), quats, moves / radius, np.ones(len(times)))
    found = noise.estimate(track)
    return _BOTH * max(radius * found.place, least[0]), _BOTH * max(found.turn, least[1])


def _hinge(motion: _RelativeMotion) -> _Trial:
    (quats, moves), robust = motion.poses, motion.weights
    pairs = rotations.multiply(quats[:, None], rotations.conjugate(quats))[..., 1:]  # sin(angle / 2) axis
    axis, shift, angles, closed = np.zeros(3), np.zeros(3), np.zeros(len(quats)), motion.poses
    for _ in range(_ROUNDS):
        axis = _main_axis(np.einsum("s,r,srx,sry->xy", robust, robust, pairs, pairs))
        angles = _angles(quats, axis)
        angles = angles - angles[-1]
        closed_quats = rotations.rotvecs_to_quats(angles[:, None] * axis)
        shift = _pivot(closed_quats, moves, robust)
        closed = closed_quats, shift - rotations.rotate(closed_quats, shift)
        robust = motion.reweighted(closed, 5)
    point = motion.c + shift
    point = point + axis * (axis @ (motion.middle - point))  # of the points of the axis, the nearest to the middle
    return _Trial(HINGE, point, axis, closed, angles, len(quats) + 4)


def _ball(motion: _RelativeMotion) -> _Trial:
    (quats, moves), robust = motion.poses, motion.weights
    shift, closed = np.zeros(3), motion.poses
    for _ in range(_ROUNDS):
        shift = _pivot(quats, moves, robust)
        closed = quats, shift - rotations.rotate(quats, shift)
        robust = motion.reweighted(closed, 3)
    return _Trial(BALL, motion.c + shift, None, closed, np.zeros(0), 3 * len(quats) + 3)


def _slider(motion: _RelativeMotion) -> _Trial:
    (quats, moves), robust = motion.poses, motion.weights
    axis, closed = np.zeros(3), motion.poses
    for _ in range(_ROUNDS):
        axis = _main_axis(np.einsum("s,sx,sy->xy", robust, moves, moves))
        closed = rotations.identity(len(quats)), np.outer(moves @ axis, axis)
        robust = motion.reweighted(closed, 5)
    return _Trial(SLIDER, motion.middle, axis, closed, moves @ axis, len(quats) + 2)


def _pivot(quats: np.ndarray, moves: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the point, relative to c, that the relative motion leaves in place; of several, the nearest to c. [3]"""
    root = np.sqrt(weights)[:, None]
    arms = ((np.eye(3) - rotations.quats_to_rotmats(quats)) * root[..., None]).reshape(-1, 3)
    return np.linalg.lstsq(arms, (moves * root).ravel(), rcond=0.03)[0]


def _main_axis(moments: np.ndarray) -> np.ndarray:
    """Return the direction of the largest second moment; its largest component is positive. [3, 3] -> [3]"""
    axis = np.linalg.eigh(moments)[1][:, -1]
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def _angles(quats: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the angles of rotations about an axis, without jumps. [S, 4] -> [S]"""
    return np.unwrap(2 * np.arctan2(quats[:, 1:] @ axis, quats[:, 0]))


def _near(trial: _Trial, parent: Link, child: Link) -> bool:
    """Return True if the joint is close to both bodies, which matters for hinges and balls only."""
    links = () if trial.kind == SLIDER else (parent, child)
    return all(np.linalg.norm(trial.point - link.pivot) <= FARTHEST * link.radius for link in links)


def _moves(trial: _Trial, sigmas: tuple[float, float]) -> bool:
    """Return True if the joint moves by more than its noise."""
    if trial.kind == BALL:
        angles = rotations.angle_between(trial.closed[0], trial.closed[0][-1])
        return float(angles.max()) > MIN_RANGE * sigmas[1]
    sigma = sigmas[0] if trial.kind == SLIDER else sigmas[1]
    return float(np.ptp(trial.coordinates)) > MIN_RANGE * sigma


def _result(times: np.ndarray, trial: _Trial, cost: float, motion: _RelativeMotion, child: Link) -> Found:
    """Return the joint with the motion model of its coordinate."""
    weights = motion.weights
    errors = se3.differences(motion.poses, trial.closed, 1.0, 1.0)[weights > 0]
    place, turn = (float(np.sqrt((part**2).sum(1).mean())) for part in (errors[:, :3], errors[:, 3:]))
    quats = trial.closed[0] if trial.kind != SLIDER else rotations.identity(len(times))
    moves = trial.closed[1] if trial.kind == SLIDER else np.zeros((len(times), 3))
    radius = max(child.radius, float(np.linalg.norm(child.pivot - trial.point)))
    least = motion.sigmas[0] / _BOTH, motion.sigmas[1] / _BOTH
    fit = model_selection.fit(times, quats, moves, radius=radius, weights=weights, least_noise=least)
    model = joints.closed(trial.kind, trial.axis, fit.model)
    limits = None if trial.kind == BALL else (float(trial.coordinates.min()), float(trial.coordinates.max()))
    found = Joint(trial.kind, trial.point, trial.axis, limits, model)
    if limits is not None:
        found = replace(found, stop_time=_stop_time(found, trial.coordinates, float(times[-1] - times[0])))
    return Found(found, cost, place, turn, fit.history)


def _stop_time(joint: Joint, coordinates: np.ndarray, span: float) -> float | None:
    """Return the time at which the prediction passes a limit at which the joint turned around, or None.

    An end of the range that the joint reaches at t_max or leaves at the first time is no limit.
    """
    assert joint.limits is not None and joint.axis is not None
    low, high = joint.limits
    slack, inner = SLACK * (high - low), coordinates[1:-1]
    turned = inner.min(initial=np.inf) <= low + 1e-12, inner.max(initial=-np.inf) >= high - 1e-12
    tau = np.linspace(0.0, _HORIZON * span, 2048)
    quats, moves = joint.poses(tau)
    path = moves @ joint.axis if joint.kind == SLIDER else _angles(quats, joint.axis)
    beyond = (turned[0] & (path < low - slack)) | (turned[1] & (path > high + slack))
    return float(tau[np.argmax(beyond)]) if beyond.any() else None


def carried(parent: Band | None, own: Band | None, lever: float, radius: float) -> Band | None:
    """Return the band of a child: that of its parent and that of its motion relative to it. None if one is unknown.

    Args:
        parent: Band of the parent.
        own: Band of the relative motion.
        lever: Distance between the pivots of both.
        radius: Radius of the child.
    """
    if parent is None or own is None:
        return None
    times = np.array(own.times)
    widths = np.hypot(parent.widths(times) + lever * parent.angles(times), own.widths(times))
    angles = np.minimum(np.hypot(parent.angles(times), own.angles(times)), math.pi)
    return bands.trusted(Band(own.times, tuple(widths.tolist()), tuple(angles.tolist()), own.level), radius)


def parents(costs: np.ndarray, root: int) -> list[int | None]:
    """Return the parent of each body of an object: the tree from the root with the cheapest joints, greedily.

    Args:
        costs: Cost of the joint between each pair, infinite without one. [B, B]
        root: The body that none carries.
    """
    found: list[int | None] = [None] * len(costs)
    reached: Sequence[int] = [root]
    while True:
        open_rows = [b for b in range(len(costs)) if b not in reached]
        pairs = [(costs[a, b], a, b) for a in reached for b in open_rows if np.isfinite(costs[a, b])]
        if not pairs:
            return found
        _, a, b = min(pairs)
        found[b] = a
        reached = [*reached, b]

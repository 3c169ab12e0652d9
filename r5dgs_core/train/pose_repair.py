"""Repair of slipped poses: knots at which the track of a body converged to a wrong local minimum of the image error.

A knot is suspicious if the image error of the body is unusually large there, or if its rotation differs much from the
rotation that constant spin between its neighbours predicts. Such a knot is registered again (`registration`) from its
own pose and from the predicted one, and if the error remains large, from rotations of the prediction, and in blurred
pictures from where constant velocity predicts the body. The pose of least image error is taken; among similar errors,
the one nearest to the prediction. If the error is unusually large in all of them, no pose explains the body, and it
keeps its own unless the error becomes much smaller: a body that bends would otherwise be registered to one of its parts
at some knots and to another part at others. After a repair, the neighbours become suspicious, so that a
series of slipped knots is repaired from its ends. Other knots keep their poses bit for bit.

A knot is checked when it enters training, because a fast body is easily lost then, and in some rounds over all knots. A
body that enters with constant spin keeps the rotation of the neighbouring knot instead if it fits the pictures better.
Balls are aligned as a whole, by their texture (`ball_repair`), once all times have entered and near the end of the run.
"""

from __future__ import annotations

import logging

import numpy as np
import torch

from ..motion import rotations
from ..motion.se3 import Pose
from ..raster.arrays import to_host
from . import ball_repair, registration
from .registration import BodyRegistration
from .representations.tracks import TracksRepresentation
from .trainer import Trainer

log = logging.getLogger(__name__)

ROUNDS = (0.45, 0.7)  # shares of the run after which all knots are checked; both follow the trial of residuals
BALLS = 0.8  # share of the run after which balls are aligned again
JUMP = np.radians(8.0)  # angle from the prediction above which a knot is suspicious
UNUSUAL = 1.5  # image error above which a knot is suspicious, relative to the median over the knots of the body
CLEARLY = 0.93  # largest image error of a new pose that is accepted, relative to that of the present one
MUCH = 0.7  # the same, of a new pose that does not explain the body either
SIMILAR = 1.03  # image error below which the pose nearest to the prediction is taken, relative to the smallest error
FAIR = 0.8  # image error above which starts from afar are tried, relative to that of an unexplained body
APART = np.radians(3.0)  # smallest angle between different poses
MOVED = 0.05  # smallest distance between different poses, radii of the body
TURNS = np.radians((25.0, 50.0))  # rotations of the prediction about each axis that are tried as starts
VIEWS = 3  # maximum number of views of a knot
REFINED = 2  # number of starts that are refined
STEPS = 4  # steps of a refinement
FAR_STEPS = 8  # steps of a refinement from a predicted displacement, of blurred and of sharp pictures
MAX_REGISTRATIONS_PER_KNOT = 2  # maximum registrations of a body in a round, relative to the number of its knots


def applies(trainer: Trainer) -> bool:
    """Return True if bodies have tracks of four or more knots, and masks show them."""
    masked = any(view.has_mask for view in trainer.given_views)
    tracked = isinstance(trainer.motion, TracksRepresentation)
    return trainer.config.train.repair and tracked and masked and len(trainer.times) > 3


def after_step(trainer: Trainer, entered: tuple[int, int]) -> None:
    """Repair poses after a step if it is due.

    Args:
        trainer: A run.
        entered: First and last knot that took part before the step.
    """
    if not applies(trainer):
        return
    first, last = trainer.curriculum.entered
    new = [s for s in (*range(entered[0] - 1, first - 1, -1), *range(entered[1] + 1, last + 1))]
    if new:
        for s in new:
            hold_rotations(trainer, s, s + 1 if s < entered[0] else s - 1)
        usual = registration.errors(trainer, trainer.first_time, VIEWS)
        for s in new:
            for row in np.flatnonzero(registration.errors(trainer, s, VIEWS) > UNUSUAL * usual):
                knots = np.flatnonzero(trainer.places.measured[row])
                knots = knots[(knots >= first) & (knots <= last)]
                _repair_knot(trainer, int(row) + 1, s, knots, UNUSUAL * float(usual[row]), settled=False)
    total = trainer.config.train.iterations
    if first > 0 or last < len(trainer.times) - 1:
        return
    if trainer.iteration in {int(x * total) for x in ROUNDS}:
        repair(trainer)
    if trainer.iteration == trainer.config.curriculum.steps(total)[1] + 1:
        ball_repair.repair(trainer, ball_repair.FAR)
    if trainer.iteration == int(BALLS * total):
        ball_repair.repair(trainer)


@torch.no_grad()
def hold_rotations(trainer: Trainer, knot: int, near: int) -> None:
    """Give bodies at a new knot the rotation of a neighbour if it fits the pictures clearly better than their own.

    Bodies enter with constant spin. A wrong spin would be extrapolated to each further knot, with a growing error.

    Args:
        trainer: The run.
        knot: The new knot.
        near: The neighbour, which already takes part in training.
    """
    motion = _tracks(trainer)
    tracks, parts = motion.tracks, (motion.tracks.base_quats, motion.tracks.params["rotvecs"])
    own = [values[:, knot].clone() for values in parts]
    quats = rotations.normalize(to_host(tracks.knot_quats()[:, [knot, near]]).astype(np.float64))
    turned = np.flatnonzero(rotations.angle_between(quats[:, 0], quats[:, 1]) > APART)
    owners = to_host(tracks.owners)[turned]
    turned, owners = turned[owners > 0], owners[owners > 0]
    if not len(turned):
        return
    # All bodies together first: registering each would take long with many bodies that turn.
    before = registration.errors(trainer, knot, VIEWS)[owners - 1]
    for values in parts:
        values[turned, knot] = values[turned, near]
    after = registration.errors(trainer, knot, VIEWS)[owners - 1]
    for values, old in zip(parts, own, strict=True):
        values[:, knot] = old
    for body in turned[after < before]:
        look = BodyRegistration(trainer, motion, int(body), knot, VIEWS)
        held = quats[body, 1], look.pose[1]
        if len(look) and look.error(held) < CLEARLY * look.error(look.pose):
            look.write_pose(held)


def repair(trainer: Trainer) -> int:
    """Look at all knots of all rigid bodies, and return the number of knots with new poses."""
    motion = _tracks(trainer)
    bent = set() if motion.residuals is None else set(motion.residuals.bodies)
    count = len(trainer.times)
    errors = np.stack([registration.errors(trainer, s, VIEWS) for s in range(count)], -1)  # [B - 1, S]
    changed: dict[int, int] = {}
    for body, owner in enumerate(motion.tracks.owners.tolist()[1:], start=1):
        own = errors[owner - 1]
        seen = np.flatnonzero(np.isfinite(own))
        if body in bent:
            continue
        queue = suspicious(own, _quats(trainer, body), trainer.times).tolist()
        limit = UNUSUAL * float(np.median(own[seen])) if queue else 0.0
        found: set[int] = set()
        for _ in range(MAX_REGISTRATIONS_PER_KNOT * count):
            if not queue:
                break
            s = queue.pop(0)
            if _repair_knot(trainer, body, s, seen, limit, settled=True):
                found.add(s)
                queue += [int(n) for n in seen if abs(n - s) == 1 and n not in queue]
        if found:
            changed[int(trainer.object_ids[owner])] = changed.get(int(trainer.object_ids[owner]), 0) + len(found)
    if changed:
        log.info("poses repaired: %s", ", ".join(f"{n} of object {key}" for key, n in changed.items()))
    return sum(changed.values())


def suspicious(errors: np.ndarray, quats: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Find the knots of a body that may have slipped.

    Args:
        errors: Mean squared error of its pixels, nan if it is not visible. [S]
        quats: Rotations, unit wxyz. [S, 4]
        times: Knots. [S]

    Returns:
        Indices of visible suspicious knots, the worst first.
    """
    seen = np.flatnonzero(np.isfinite(errors))
    score = np.zeros(len(errors))
    score[seen] = errors[seen] / max(float(np.median(errors[seen])), 1e-12) / UNUSUAL if len(seen) else 0.0
    for a, s, b in zip(seen[:-2], seen[1:-1], seen[2:], strict=True):
        expected = _between(times, quats, a, b, s)
        score[s] = max(score[s], float(rotations.angle_between(quats[s], expected)) / JUMP)
    found = np.flatnonzero(score > 1)
    return found[np.argsort(-score[found], kind="stable")]


def _repair_knot(trainer: Trainer, body: int, knot: int, seen: np.ndarray, limit: float, *, settled: bool) -> bool:
    """Register a knot; return True if it has a new pose.

    Args:
        trainer: The run.
        body: Row of the body.
        knot: The knot.
        seen: Knots that may predict it.
        limit: Picture error above which the body is not explained. Turns of the prediction are then tried; if they do
            not explain it either, it may bend, and keeps its pose unless the error becomes much smaller.
        settled: True if all times have entered. Before, the body is not yet sharp, so it is not searched from afar,
            moved without a turn, or registered in a single view.
    """
    look = BodyRegistration(trainer, _tracks(trainer), body, knot, VIEWS)
    predicted, carried = _predictions(trainer, body, knot, seen)
    if len(look) < (1 if settled else 2) or not predicted:
        return False
    own = look.pose
    found = [look.refined(pose, STEPS) for pose in [own, *predicted[:1]][: 1 + _apart(own, predicted[0])]]
    if min(error for _, error in found) > limit:
        turned = sorted(_turned(predicted[0]) + predicted[1:], key=look.error)
        found += [look.refined(pose, STEPS) for pose in turned[:REFINED]]
    while settled and carried and min(error for _, error in found) > FAIR * limit:
        found.append(look.refined_from_afar(carried.pop(0), FAR_STEPS))
    least = min(error for _, error in found)
    near = [pose for pose, error in found if error <= SIMILAR * least]
    best = min(near, key=lambda pose: float(rotations.angle_between(pose[0], predicted[0][0])))
    moved = float(np.linalg.norm(best[1] - own[1])) > MOVED * look.radius
    before = look.error(own)
    most = max(limit, MUCH * before) if settled else limit
    better = (_apart(best, own) or (settled and moved)) and least < min(CLEARLY * before, most)
    if better:
        look.write_pose(best)
    return better


def _predictions(trainer: Trainer, body: int, knot: int, seen: np.ndarray) -> tuple[list[Pose], list[Pose]]:
    """Poses that other knots predict: between neighbours, from before, from after; or the nearest.

    Returns:
        Poses by constant spin at the present displacement, and poses by constant spin and constant velocity.
    """
    before, after = seen[seen < knot][::-1], seen[seen > knot]
    pairs = [(side[0], side[1]) for side in (before, after) if len(side) > 1]
    if len(before) and len(after):
        pairs.insert(0, (before[0], after[0]))
    tracks, quats = _tracks(trainer).tracks, _quats(trainer, body)
    shifts = to_host(tracks.params["translations"])[body].astype(np.float64)
    turns = [_between(tracks.times, quats, a, b, knot) for a, b in pairs]
    moves = [shifts[a] + _share(tracks.times, a, b, knot) * (shifts[b] - shifts[a]) for a, b in pairs]
    nearest = [quats[side[0]] for side in (before, after) if len(side)][:1]
    return [(q, shifts[knot]) for q in turns or nearest], list(zip(turns, moves, strict=True))


def _tracks(trainer: Trainer) -> TracksRepresentation:
    assert isinstance(trainer.motion, TracksRepresentation)
    return trainer.motion


def _quats(trainer: Trainer, body: int) -> np.ndarray:
    return rotations.normalize(to_host(_tracks(trainer).tracks.knot_quats())[body].astype(np.float64))


def _between(times: np.ndarray, quats: np.ndarray, a: int, b: int, s: int) -> np.ndarray:
    """Rotation at knot s by constant spin from knot a to knot b; s may lie outside. [4]"""
    return rotations.interpolate(quats[a], quats[b], _share(times, a, b, s))


def _share(times: np.ndarray, a: int, b: int, s: int) -> float:
    """Time of knot s as a share of the time from knot a to knot b."""
    return (times[s] - times[a]) / (times[b] - times[a])


def _turned(pose: Pose) -> list[Pose]:
    """Turns of a pose about the axes of a cube's faces and corners."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    axes = np.concatenate([np.eye(3), -np.eye(3), corners])
    turns = rotations.rotvecs_to_quats(np.concatenate([angle * axes for angle in TURNS]))
    return [(rotations.normalize(rotations.multiply(turn, pose[0])), pose[1]) for turn in turns]


def _apart(a: Pose, b: Pose) -> bool:
    return bool(rotations.angle_between(a[0], b[0]) > APART)

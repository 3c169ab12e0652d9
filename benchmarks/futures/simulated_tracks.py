"""Named simulated motions, and noisy observations of them with known truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from . import scoring
from . import simulated_events as events
from . import simulated_motions as motions
from .simulated_motions import POSES, RADIUS, T_MAX, Maker, Motion, box_inertia, grid, turned

MOTIONS: dict[str, Maker] = {
    "steady": motions.steady,
    "ballistic": motions.ballistic,
    "hinge": motions.hinge,
    "pendulum": motions.pendulum,
    "circle": motions.circle,
    "tumbling": motions.tumbling,
    "static": motions.static,
    "slow": motions.slow,
    "late start": events.within(events.starts, 0.15, 0.5),
    "collision": events.within(events.collides, 0.15, 0.55),
    "drag": motions.drag,
    "fall with drag": motions.falls_with_drag,
    "gyroscope": motions.gyroscope,
    "friction, stops after t_max": motions.rolls_until(0.8, 1.0),
    "friction, stops inside": motions.rolls_until(0.35, 0.6),
    "friction, slides": motions.slides_until(0.8, 1.0),
    "bounces": motions.bounces,
    "bounces, rough floor": motions.bounces_on_rough_floor,
    "one bounce": events.within(events.bounces_once, 0.25, 0.5),
    "damped spring": motions.damped_spring,
    "damped pendulum": motions.damped_pendulum,
    "Lissajous": motions.lissajous,
    "double pendulum": motions.double_pendulum,
    "slow Lissajous": motions.slow_lissajous,
    "collision, 3 left": events.left(events.collides, 3),
    "late start, 3 left": events.left(events.starts, 3),
    "stop, 3 left": events.left(events.stops, 3),
    "one bounce, 3 left": events.left(events.bounces_once, 3),
    "falls from a table, 5 left": events.left(events.leaves_table, 5),
    "steady, last one slipped": events.slipped(motions.steady, 1),
    "steady, last 3 slipped": events.slipped(motions.steady, 3),
    "ballistic, last 3 slipped": events.slipped(motions.ballistic, 3),
    "ballistic, last 5 slipped": events.slipped(motions.ballistic, 5),
}


SLOW_PLACE, SLOW_DEGREES = (0.0015, 0.015), (0.3, 3.0)  # ranges of slow errors: body sizes, degrees
SLOW_LENGTH = (0.1, 1.5)  # range of their correlation length, in observed spans
CLAIM = 1.9  # typical ratio of claimed to true slow errors, or its inverse


@dataclass(frozen=True)
class Noise:
    """Noise of observed poses.

    Attributes:
        place: Standard deviation per component, in body sizes (2 `RADIUS`).
        degrees: The same of rotations.
        correlation: Correlation with the previous pose.
        outliers: Share of poses that are ten times as noisy.
        slow: True for additional `slow_errors`, as tracks from images have.
    """

    place: float
    degrees: float
    correlation: float = 0.0
    outliers: float = 0.0
    slow: bool = False


NOISES = {
    "white": Noise(0.005, 0.8),
    "correlated": Noise(0.005, 0.8, correlation=0.7),
    "heavy": Noise(0.005, 0.8, outliers=0.05),
    "coarse": Noise(0.02, 3.0),
    "low": Noise(0.001, 0.2),
    "slow": Noise(0.001, 0.2, slow=True),
}


@dataclass(frozen=True)
class Draw:
    """An observed track and its true future.

    Attributes:
        times: Observed times. [S]
        places: Observed places. [S, 3]
        turns: Observed rotations. [S]
        later: Times after `T_MAX`; the last is 1. [H]
        true_places: True places there. [H, 3]
        true_turns: True rotations there. [H]
        motion: The motion.
        inertia: Inertia of the body in its last observed pose, world axes. [3, 3]
        claimed: Standard deviations that are claimed for slow errors of places, world units, and rotations, rad.
    """

    times: np.ndarray
    places: np.ndarray
    turns: Rotation
    later: np.ndarray
    true_places: np.ndarray
    true_turns: Rotation
    motion: Motion
    inertia: np.ndarray
    claimed: tuple[float, float]


def slow_errors(rng: np.random.Generator, times: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Draw errors that change slowly, with mean zero, and the standard deviations that are claimed for them.

    Args:
        rng: Random generator.
        times: Observed times. [S]

    Returns:
        Errors of places, world units, and of rotations, rad [S, 6]; claimed deviations of both, per component.
    """
    place, degrees = (math.exp(rng.uniform(*np.log(x))) for x in (SLOW_PLACE, SLOW_DEGREES))
    true = 2 * RADIUS * place, math.radians(degrees)
    claimed = true[0] * CLAIM ** rng.normal(), true[1] * CLAIM ** rng.normal()
    apart = np.abs(times[:, None] - times) / (times[-1] - times[0]) / math.exp(rng.uniform(*np.log(SLOW_LENGTH)))
    kernel = np.exp(-apart) if rng.random() < 0.5 else np.exp(-0.5 * apart**2)
    values = np.linalg.cholesky(kernel + 1e-9 * np.eye(len(times))) @ rng.normal(size=(len(times), 6))
    values -= values.mean(0)
    spread = np.sqrt((values**2).mean(0).reshape(2, 3).mean(1))
    return values * np.repeat(np.array(true) / spread, 3), claimed


def draw(name: str, noise: Noise, seed: int, poses: int = POSES) -> Draw:
    """Observe a random motion of a kind; equal arguments give equal draws."""
    rng = np.random.default_rng([seed, sum(name.encode())])
    motion = MOTIONS[name](rng)
    times = grid(poses)
    later = np.linspace(T_MAX, 1.0, 6)[1:]
    places, turns = motion.path(times)
    matrix = turns[-1].as_matrix()
    values = rng.normal(size=(poses, 6))
    rho = noise.correlation
    for i in range(1, poses):
        values[i] = rho * values[i - 1] + math.sqrt(1 - rho**2) * values[i]
    values *= np.where(rng.uniform(size=(poses, 1)) < noise.outliers, 10.0, 1.0)
    slow, claimed = slow_errors(rng, times) if noise.slow else (np.zeros((poses, 6)), (0.0, 0.0))
    slip = np.where(np.arange(poses)[:, None] >= poses - motion.slipped, motion.slip, 0.0)
    return Draw(
        times,
        places + noise.place * 2 * RADIUS * values[:, :3] + slow[:, :3],
        turned(math.radians(noise.degrees) * values[:, 3:] + slow[:, 3:]) * turns * turned(slip),
        later,
        *motion.path(later),
        motion,
        matrix @ box_inertia() @ matrix.T,
        claimed,
    )


def errors(places: np.ndarray, turns: Rotation, truth: Draw) -> np.ndarray:
    """Root mean square error over the surface of the body's ball at the later times, in % of its size. [H]"""
    distances = np.linalg.norm(places - truth.true_places, axis=-1)
    return scoring.surface_error(distances, (turns * truth.true_turns.inv()).magnitude(), 2 * RADIUS)

"""Simulated motions with one event: collisions, starts, stops, single bounces, and slipped rotations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from .simulated_motions import POSES, RADIUS, UP, Maker, Motion, Poses, direction, grid, turned

EventMaker = Callable[[np.random.Generator, float], Motion]


def _jump(at: float, v: tuple[np.ndarray, np.ndarray], w: tuple[np.ndarray, np.ndarray], g: float = 0.0) -> Motion:
    def path(t: np.ndarray) -> Poses:
        before, after = np.minimum(t - at, 0)[:, None], np.maximum(t - at, 0)[:, None]
        fall = 0.5 * g * (t[:, None] - at) ** 2 * UP
        return v[0] * before + v[1] * after - fall, turned(w[1] * after) * turned(w[0] * before)

    size = math.hypot(np.linalg.norm(v[1] - v[0]), RADIUS * np.linalg.norm(w[1] - w[0]))
    return Motion(path, (at,), float(size))


def collides(rng: np.random.Generator, at: float) -> Motion:
    """Velocity and spin change at once."""
    v, w = rng.normal(size=(2, 3)), 1.5 * rng.normal(size=(2, 3))
    return _jump(at, (v[0], v[1]), (w[0], w[1]))


def starts(rng: np.random.Generator, at: float) -> Motion:
    """A body at rest that starts to move at once."""
    return _jump(at, (np.zeros(3), 1.2 * rng.normal(size=3)), (np.zeros(3), 2 * rng.normal(size=3)))


def stops(rng: np.random.Generator, at: float) -> Motion:
    """A moving body that stops at once."""
    return _jump(at, (1.2 * rng.normal(size=3), np.zeros(3)), (2 * rng.normal(size=3), np.zeros(3)))


def bounces_once(rng: np.random.Generator, at: float) -> Motion:
    """A flight with one bounce that changes the spin; the next one comes after t = 1."""
    g, keep, speed = 12.0, rng.uniform(0.6, 0.9), rng.uniform(4.2, 5.5)
    across, w = np.array([*(0.6 * rng.normal(size=2)), 0.0]), 1.5 * rng.normal(size=3)
    return _jump(at, (across - speed * UP, across + keep * speed * UP), (w, w + rng.normal(size=3)), g)


def leaves_table(rng: np.random.Generator, at: float) -> Motion:
    """A sliding body falls from the edge of a table."""
    v, w = rng.normal(size=3) * [0.9, 0.9, 0], 1.5 * rng.normal(size=3)

    def path(t: np.ndarray) -> Poses:
        return v * t[:, None] - 5.0 * np.maximum(t - at, 0)[:, None] ** 2 * UP, turned(w * t[:, None])

    return Motion(path, (at,))


def within(make: EventMaker, low: float, high: float) -> Maker:
    """A motion with an event between two times."""
    return lambda rng: make(rng, rng.uniform(low, high))


def left(make: EventMaker, poses: int) -> Maker:
    """A motion with a given number of observed poses after its event."""
    times = grid()
    low, step = times[POSES - poses - 1], times[1] - times[0]
    return lambda rng: make(rng, low + step * rng.uniform(0.05, 0.95))


def slipped(make: Maker, poses: int) -> Maker:
    """A motion whose last observed rotations slipped by a constant turn in the body's frame."""

    def slip(rng: np.random.Generator) -> Motion:
        motion = make(rng)
        return dataclasses.replace(motion, slip=math.radians(rng.uniform(15, 60)) * direction(rng), slipped=poses)

    return slip

"""Recorded simulations: every step, with the contacts, up to rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..motion import rotations
from .simulation import Simulation
from .world import State

_REST_SPEED = 2e-3  # in units of sqrt(g size)
_REST_TIME = 0.3  # in units of sqrt(size / g)
_CHECKED = 64  # steps between two checks for rest
_MERGED = 20.0  # time between two contacts of the same bodies that count as one, in units of 1 / w
_FELT = 0.01  # change of velocity that counts as an impact, as a share of the largest speed


@dataclass(frozen=True)
class Touch:
    """Start of a contact.

    Attributes:
        time: Time since the start.
        bodies: Numbers of the two bodies, -1 for the plane.
        change: Change of velocity of the first moving one during the contact; 0 if it began gently.
    """

    time: float
    bodies: tuple[int, int]
    change: float


@dataclass(frozen=True)
class Recording:
    """Steps of a simulation of B bodies.

    Attributes:
        times: N times since the start. [N]
        quats: Rotations relative to the bind state. [N, B, 4]
        places: Centres of mass. [N, B, 3]
        spins: Angular velocities, world frame. [N, B, 3]
        velocities: Of the centres of mass. [N, B, 3]
        touching: True while a body is pushed. [N, B]
        touches: Starts of contacts, in order.
        rests: True if all bodies have rested for a while at the end.
        slow: True for bodies that hardly move at the end. [B]
        frequency: Angular frequency of the contacts.
    """

    times: np.ndarray
    quats: np.ndarray
    places: np.ndarray
    spins: np.ndarray
    velocities: np.ndarray
    touching: np.ndarray
    touches: tuple[Touch, ...]
    rests: bool
    slow: np.ndarray
    frequency: float


@np.errstate(over="ignore")  # huge speeds of a simulation that is about to fail have no square
def record(simulation: Simulation, state: State, duration: float) -> Recording:
    """Simulate from a state for a duration, or until all bodies rest."""
    simulation.load(state)
    model, data, mujoco = simulation.model, simulation.data, simulation.mujoco
    count, bodies = int(np.ceil(duration / simulation.stepping.step)) + 1, len(state.places)
    times, positions, rates = np.empty(count), np.empty((count, model.nq)), np.empty((count, model.nv))
    touching = np.zeros((count, bodies), bool)
    last: dict[tuple[int, int], float] = {}
    begins: list[tuple[int, tuple[int, int]]] = []
    slow_since, rests, n = None, False, 0
    for n in range(count):
        times[n], positions[n], rates[n] = data.time, data.qpos, data.qvel
        if n % _CHECKED == 0 and model.nv:
            slow = _slow(simulation).all()
            slow_since = (data.time if slow_since is None else slow_since) if slow else None
            rests = slow_since is not None and data.time - slow_since > _rest_time(simulation)
        if rests or n == count - 1:
            break
        mujoco.mj_step(model, data)
        if not data.ncon:
            continue
        for pair in simulation.contacts():
            if data.time - last.get(pair, -np.inf) > _MERGED / simulation.stepping.frequency:
                begins.append((n, pair))
            last[pair] = data.time
            touching[n, [i for i in pair if i >= 0]] = True
    count = n + 1
    return _recording(simulation, times[:count], positions[:count], rates[:count], touching[:count], begins, rests)


def _recording(
    simulation: Simulation,
    times: np.ndarray,
    positions: np.ndarray,
    rates: np.ndarray,
    touching: np.ndarray,
    begins: list[tuple[int, tuple[int, int]]],
    rests: bool,
) -> Recording:
    bodies, count = simulation.world.bodies, len(times)
    moving = [i for i, body in enumerate(bodies) if not body.fixed]
    places = np.tile(np.array([body.solid.center for body in bodies]), (count, 1, 1))
    quats = rotations.identity(count, len(bodies))
    spins, velocities = np.zeros((count, len(bodies), 3)), np.zeros((count, len(bodies), 3))
    poses, slopes = positions.reshape(count, -1, 7), rates.reshape(count, -1, 6)
    places[:, moving], quats[:, moving] = simulation.unit * poses[..., :3], poses[..., 3:]
    velocities[:, moving] = simulation.unit * slopes[..., :3]
    spins[:, moving] = rotations.rotate(poses[..., 3:], slopes[..., 3:])
    felt, wait = _FELT * np.abs(velocities).max(initial=0.0), 10 / simulation.stepping.frequency
    touches = []
    for n, pair in begins:
        body = next(i for i in pair if i in moving)
        later = min(int(np.searchsorted(times, times[n] + wait)), count - 1)
        change = float(np.linalg.norm(velocities[later, body] - velocities[n, body]))
        touches.append(Touch(float(times[n]), pair, change if change > felt else 0.0))
    slow, frequency = np.ones(len(bodies), bool), simulation.stepping.frequency
    slow[moving] = _slow(simulation)
    return Recording(times, quats, places, spins, velocities, touching, tuple(touches), bool(rests), slow, frequency)


def _slow(simulation: Simulation) -> np.ndarray:
    """True for each moving body that hardly moves."""
    g = float(np.linalg.norm(simulation.world.gravity))
    sizes = np.array([body.solid.size for body in simulation.world.bodies if not body.fixed])
    rates = simulation.data.qvel.reshape(-1, 6)
    speeds = simulation.unit * np.linalg.norm(rates[:, :3], axis=1) + sizes * np.linalg.norm(rates[:, 3:], axis=1)
    return speeds < _REST_SPEED * np.sqrt(max(g, 1e-300) * sizes)


def _rest_time(simulation: Simulation) -> float:
    g = float(np.linalg.norm(simulation.world.gravity))
    sizes = [body.solid.size for body in simulation.world.bodies if not body.fixed]
    return _REST_TIME * np.sqrt(max(sizes) / g) if g > 0 else np.inf

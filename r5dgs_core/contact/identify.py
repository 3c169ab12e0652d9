"""State, friction and restitution of a body from its observed poses, by least squares over simulations.

Notation: the parameters are deviations from a reference: place, rotation, velocity and spin, with lengths in sizes of
the body and times in sqrt(size / g), then the logarithm of the friction and the logit of the restitution.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import levenberg_marquardt, robust_weights, rotations, se3
from . import world as worlds
from .simulation import Simulation
from .world import Material, State

PARAMETERS = 14
LAST = 4  # poses that determine the state at t_max
_STEPS = np.repeat([0.002, 0.003, 0.002, 0.003, 0.03, 0.1], [3, 3, 3, 3, 1, 1])  # of differences
_OUTLIER = 9.0  # squared residual of a pose whose weight is one half
_FRICTIONS, _RESTITUTIONS = (0.1, 0.18, 0.3, 0.5), (0.1, 0.3, 0.6)  # first guesses
_LEARNED = np.array([0.1, 0.5])  # least deviations of log friction and logit of restitution from the whole track
_LOST = 10.0  # residual, in units of the noise, of a pose that a guess misses
_CLOSE = 0.04  # gap, as a share of the size, below which a pose may be in contact
_EARLY, _FULL = 5, 8  # iterations


@dataclass(frozen=True)
class Track:
    """Observed poses of a body.

    Attributes:
        times: Increasing. [S]
        quats: Relative to the bind state. [S, 4]
        places: Centres of mass. [S, 3]
        place_noise: Standard deviation of a place per axis. [S]
        turn_noise: The same of a rotation, rad. [S]
    """

    times: np.ndarray
    quats: np.ndarray
    places: np.ndarray
    place_noise: np.ndarray
    turn_noise: np.ndarray

    def __len__(self) -> int:
        return len(self.times)

    def rows(self, rows: slice) -> Track:
        """Select poses."""
        return Track(
            *(column[rows] for column in (self.times, self.quats, self.places, self.place_noise, self.turn_noise))
        )


@dataclass(frozen=True)
class Prior:
    """Normal distributions of the logarithm of the friction and the logit of the restitution.

    Attributes:
        material: Their means.
        friction, restitution: Their standard deviations.
    """

    material: Material
    friction: float
    restitution: float


WIDE = Prior(Material(0.3, 0.3), 0.6, 1.0)


@dataclass(frozen=True)
class Estimate:
    """Result of a fit.

    Attributes:
        state: State of the body at ``time``.
        time: Time of the first pose that was fitted.
        material: Friction and restitution.
        covariance: Of the parameters of the module's notation. [14, 14]
        assumed: Precision of the parameters that comes from the prior and not from poses. [14]
        cost: Weighted sum of squared residuals, with the prior.
        misfit: Mean squared residual in units of the noise.
    """

    state: State
    time: float
    material: Material
    covariance: np.ndarray
    assumed: np.ndarray
    cost: float
    misfit: float


class Fitter:
    """Fits of one body, the only one of a simulation that moves or the one with a given number.

    Args:
        simulation: A draft simulation.
        track: Observed poses.
    """

    def __init__(self, simulation: Simulation, track: Track, body: int = 0):
        self.simulation, self.track, self.body = simulation, track, body
        world = simulation.world
        self.size = world.bodies[body].solid.size
        g = float(np.linalg.norm(world.gravity))
        self.unit_time = float(np.sqrt(self.size / g)) if g > 0 else float(np.ptp(track.times)) or 1.0
        self.scales = np.repeat([self.size, 1.0, self.size / self.unit_time, 1 / self.unit_time, 1.0], [3, 3, 3, 3, 2])

    def run(self, prior: Prior = WIDE) -> Estimate:
        """Fit material and state by the whole track, then the state by its last poses."""
        first = self._whole(prior)
        rows = slice(max(len(self.track) - LAST, 0), None)
        start = self.at(first, float(self.track.times[rows][0]))
        if not self._touched():  # nothing was learned about the material
            return first
        wide, learned = np.array([prior.friction, prior.restitution]), np.sqrt(np.diag(first.covariance)[12:])
        kept = np.minimum(np.maximum(_LEARNED, learned), wide)
        last = self.fit(start, first.material, self.track.rows(rows), Prior(first.material, *kept.tolist()), _FULL)
        assumed = np.zeros(PARAMETERS)  # the prior of the last fit comes from poses, unless these told little
        assumed[12:] = np.where(learned > _LEARNED, first.assumed[12:], 0.0)
        return dataclasses.replace(last, assumed=assumed)

    def _touched(self) -> bool:
        return self._flight() < len(self.track)

    def _whole(self, prior: Prior) -> Estimate:
        track, flight = self.track, max(self._flight(), min(3, len(self.track)))
        start = self.ballistic(track.rows(slice(0, flight)))
        if not self._touched():
            return self.fit(start, prior.material, track, prior, _FULL)
        found, count = [], len(track)
        for guess in self._guesses(start):
            near, grown = (start, guess), []
            for rows in sorted({min(count, flight + 2), min(count, (flight + 2 + count) // 2), count}):
                steps = _FULL if rows == count else _EARLY
                grown.append(self.fit(*near, track.rows(slice(0, rows)), prior, steps))
                near = grown[-1].state, grown[-1].material
            found += [grown[-1], self.fit(start, guess, track, prior, _FULL)]
        return min(found, key=lambda estimate: estimate.cost)

    def _guesses(self, start: State) -> list[Material]:
        """First guesses of the material: the one that follows most poses, and the one that misses none by much."""
        materials = [Material(mu, e) for mu in _FRICTIONS for e in _RESTITUTIONS]
        same = self._many_moved(start, materials[0], np.zeros((len(materials), PARAMETERS)))[0]
        missed = np.nan_to_num(self._residuals(same, materials, self.track), nan=1e9)
        squares = (missed**2).sum(axis=-1)
        losses = np.minimum(np.sqrt(squares), _LOST), robust_weights.cauchy_losses(squares, _OUTLIER)
        best = [int(np.argmin(loss.sum(axis=1))) for loss in losses]
        return [materials[k] for k in dict.fromkeys(best)]

    def fit(self, state: State, material: Material, track: Track, prior: Prior, steps: int) -> Estimate:
        """Fit from a state at the time of the first pose of a track."""
        theta = _logs(material) - _logs(prior.material)
        precision = np.append(np.zeros(12), [1 / prior.friction, 1 / prior.restitution])
        start = np.append(np.zeros(12), theta)

        def linearized(x: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            values, slopes = zip(*(self._linearized(state, prior, track, row) for row in x), strict=True)
            return np.array(values), np.array(slopes)

        found = levenberg_marquardt.solve_linearized(
            linearized, start[None], precision=precision, softness=_OUTLIER, steps=steps
        ).row(0)
        moved, learned = self.moved(state, prior.material, found.x)
        ridge = np.diag(1e-9 * np.maximum(np.diag(found.normal), 1e-9))
        covariance = np.linalg.inv(found.normal + ridge)
        misfit = float((found.residuals**2).mean())
        return Estimate(moved, float(track.times[0]), learned, covariance, precision**2, float(found.cost), misfit)

    def moved(self, state: State, material: Material, x: np.ndarray) -> tuple[State, Material]:
        """State and material with deviations [14] in the module's notation."""
        states, (changed,) = self._many_moved(state, material, x[None])
        return State(states.places[0], states.quats[0], states.velocities[0], states.spins[0]), changed

    def _many_moved(self, state: State, material: Material, x: np.ndarray) -> tuple[State, list[Material]]:
        """N states and materials with deviations. [N, 14]"""
        d = (x[:, :12] * self.scales[:12]).reshape(-1, 4, 1, 3)
        quats = rotations.normalize(rotations.multiply(rotations.rotvecs_to_quats(d[:, 1]), state.quats))
        changed = State(state.places + d[:, 0], quats, state.velocities + d[:, 2], state.spins + d[:, 3])
        logs = _logs(material) + x[:, 12:]
        return changed, [_material(*row) for row in logs.tolist()]

    def at(self, estimate: Estimate, time: float) -> State:
        """State of an estimate at a later time."""
        self.simulation.touch(self._materials(estimate.material))
        self.simulation.load(self._all(estimate.state))
        return self.simulation.state_at(time - estimate.time).one(self.body)

    def poses(self, state: State, material: Material, times: np.ndarray) -> se3.Pose:
        """Poses of the body at times since a state. [T, 4], [T, 3]"""
        quats, places = self._many_poses(_batch_of_one(state), [material], times)
        return quats[0], places[0]

    def _many_poses(self, states: State, materials: Sequence[Material], times: np.ndarray) -> se3.Pose:
        """Poses of the body at times since each of N states. [N, T, 4], [N, T, 3]"""
        used = [self._materials(material) for material in materials]
        quats, places = self.simulation.paths(self._all(states), times, used)
        return quats[:, :, self.body], places[:, :, self.body]

    def residuals(self, state: State, material: Material, time: float) -> np.ndarray:
        """Differences from the observed poses from the time of a state on, in units of the noise. [2 S', 3]"""
        rows = slice(int(np.searchsorted(self.track.times, time)), None)
        return self._residuals(_batch_of_one(state), [material], self.track.rows(rows))[0]

    def ballistic(self, track: Track) -> State:
        """State at the first of at least two poses in free flight, by a parabola and a constant spin."""
        gravity = self.simulation.world.gravity
        t = track.times - track.times[0]
        columns = np.stack([np.ones_like(t), t], axis=1)
        place, velocity = np.linalg.lstsq(columns, track.places - 0.5 * gravity * t[:, None] ** 2, rcond=None)[0]
        steps = rotations.quats_to_rotvecs(rotations.multiply(track.quats[1:], rotations.conjugate(track.quats[:-1])))
        quat, spin = track.quats[0], np.median(steps / np.diff(t)[:, None], axis=0) if len(t) > 1 else np.zeros(3)
        for _ in range(5 if len(t) > 1 else 0):
            shown = rotations.multiply(rotations.rotvecs_to_quats(spin * t[:, None]), quat)
            missed = rotations.quats_to_rotvecs(rotations.multiply(track.quats, rotations.conjugate(shown)))
            turn, more = np.linalg.lstsq(columns, missed, rcond=None)[0]
            quat, spin = rotations.multiply(rotations.rotvecs_to_quats(turn), quat), spin + more
        return State(place[None], rotations.normalize(quat)[None], velocity[None], spin[None])

    def _flight(self) -> int:
        """Number of poses before the first that is close to the plane, or that follows an impact."""
        plane = self.simulation.world.plane
        if plane is None:
            return len(self.track)
        body = self.simulation.world.bodies[self.body]
        gaps = worlds.gaps(body, plane, self.track.places, self.track.quats)
        close = gaps < _CLOSE * self.size
        if len(gaps) > 2:
            steps, drop = np.diff(self.track.times), 0.5 * float(np.linalg.norm(self.simulation.world.gravity))
            speeds = np.diff(gaps)[:-1] / steps[:-1] - drop * steps[:-1]
            close[2:] |= gaps[1:-1] + speeds * steps[1:] - drop * steps[1:] ** 2 < 0
        return int(np.argmax(close)) if close.any() else len(self.track)

    def _linearized(self, state: State, prior: Prior, track: Track, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [2 S, 3] at parameters [14], and their derivatives [14, 2 S, 3]."""
        nearby = x + np.concatenate([np.zeros((1, PARAMETERS)), np.diag(_STEPS)])
        found = self._residuals(*self._many_moved(state, prior.material, nearby), track)
        return found[0], (found[1:] - found[0]) / _STEPS[:, None, None]

    def _residuals(self, states: State, materials: Sequence[Material], track: Track) -> np.ndarray:
        """Differences from observed places and rotations in units of the noise, for N states. [N, 2 S, 3]"""
        found = self._many_poses(states, materials, track.times - track.times[0])
        missed = se3.differences(found, (track.quats, track.places), 1.0, 1.0)
        parts = missed[..., :3] / track.place_noise[:, None], missed[..., 3:] / track.turn_noise[:, None]
        return np.concatenate(parts, axis=1)

    def _materials(self, material: Material) -> Sequence[Material]:
        bodies = self.simulation.world.bodies
        return [material if i == self.body else body.material for i, body in enumerate(bodies)]

    def _all(self, states: State) -> State:
        """States [..., 1] of the body among all bodies: the others are at rest in the bind state. [..., B]"""
        everything = worlds.at_rest(self.simulation.world)
        found = {}
        for name in ("places", "quats", "velocities", "spins"):
            own, others = getattr(states, name), getattr(everything, name)
            found[name] = np.tile(others, (*own.shape[:-2], 1, 1))
            found[name][..., self.body, :] = own[..., 0, :]
        return State(**found)


def _batch_of_one(state: State) -> State:
    """Add a leading dimension of one to a state."""
    return State(state.places[None], state.quats[None], state.velocities[None], state.spins[None])


def _logs(material: Material) -> np.ndarray:
    """Logarithm of the friction and logit of the restitution. [2]"""
    e = min(max(material.restitution, 1e-3), 1 - 1e-3)
    return np.array([np.log(max(material.friction, 1e-4)), np.log(e / (1 - e))])


def _material(log_friction: float, logit: float) -> Material:
    """Inverse of `_logs`."""
    return Material(float(np.exp(np.clip(log_friction, -12, 5))), float(1 / (1 + np.exp(-logit))))

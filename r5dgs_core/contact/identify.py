"""State, friction and restitution of a body from its observed poses, by least squares over simulations.

Notation: the parameters are deviations from a reference: place, rotation, velocity and spin, with lengths in sizes of
the body and times in sqrt(size / g), then the logarithm of the friction and the logit of the restitution.

A simulation is not exact after the first contact: a hull is not the body's shape, and Coulomb's law is a model. Poses
since then have the error of the model besides their noise, and as that error changes slowly, neighbours repeat it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import levenberg_marquardt, robust_weights, rotations, se3
from ..motion.history import UNKNOWN_TURN
from . import world as worlds
from .observed_track import Track
from .simulation import Simulation
from .world import Material, State

PARAMETERS = 14
LAST = 4  # poses that determine the state at t_max
_STEPS = np.repeat([0.002, 0.003, 0.002, 0.003, 0.03, 0.1], [3, 3, 3, 3, 1, 1])  # of differences
_OUTLIER = 9.0  # squared residual of a pose whose weight is one half
_FRICTIONS, _RESTITUTIONS = (0.1, 0.18, 0.3, 0.5), (0.1, 0.3, 0.6)  # first guesses
_LEARNED = np.array([0.1, 0.5])  # least deviations of log friction and logit of restitution from the whole track
_LOST = 10.0  # residual, in units of the noise, of a pose that a guess misses
_GOOD = 0.3  # misfit of a fit after which no other start is tried
_UNFOLLOWED = 15.0  # misfit above which no simulation follows a track, so that its pieces tell more
_FOLLOWED = 4.0  # misfit of a piece up to which it tells something
_LEAST_FLIGHT = 2  # poses that determine a flight
_NEGLIGIBLE = 0.02  # gain of the cost below which a fit ends
_REPEATED = 4  # least number of poses since the first contact that show how much neighbours repeat
_LEAST_TOLD = 0.05  # least share of the information of independent poses that others have
_MISSED = 9.0  # mean squared residual of a pose that a simulation misses
_CLOSE = 0.04  # gap, as a share of the size, below which a pose may be in contact
_EARLY, _FULL = 5, 8  # iterations


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


WIDE = Prior(Material(0.3, 0.3), 0.35, 0.85)  # 95 %: friction 0.15 to 0.60, restitution 0.07 to 0.69


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
        misfit: Mean squared residual in units of the errors.
        squares: The same of each pose. [S]
        told: Information of the poses over that of independent ones, at most 1.
    """

    state: State
    time: float
    material: Material
    covariance: np.ndarray
    assumed: np.ndarray
    cost: float
    misfit: float
    squares: np.ndarray
    told: float


class Fitter:
    """Fits of one body, the only one of a simulation that moves or the one with a given number.

    Args:
        simulation: A draft simulation.
        track: Observed poses.

    Attributes:
        observed: The poses with their noise.
        track: The poses with their noise and the error of the simulation.
    """

    def __init__(self, simulation: Simulation, track: Track, body: int = 0):
        self.simulation, self.observed, self.body = simulation, track, body
        world = simulation.world
        self.size = world.bodies[body].solid.size
        g = float(np.linalg.norm(world.gravity))
        self.unit_time = float(np.sqrt(self.size / g)) if g > 0 else float(np.ptp(track.times)) or 1.0
        self.scales = np.repeat([self.size, 1.0, self.size / self.unit_time, 1 / self.unit_time, 1.0], [3, 3, 3, 3, 2])
        self.flight = self._flight()
        self.track = track.with_model_error(self.flight, self.size)

    def run(self, prior: Prior = WIDE) -> Estimate:
        """Fit material and state by the whole track, then the state by its last poses."""
        first = self._whole(prior)
        if not self._touched():  # nothing was learned about the material
            return first
        pieces = None if first.misfit < _UNFOLLOWED else self._by_pieces(prior)
        material, learned = pieces or (first.material, first.covariance[12:, 12:])
        deviations = np.sqrt(np.diag(learned))
        kept = np.minimum(np.maximum(_LEARNED, deviations), [prior.friction, prior.restitution])
        rows, missed = self._last(first)
        start = self.ballistic(rows.rows(slice(0, 2))) if missed else self.at(first, float(rows.times[0]))
        last = self.fit(start, material, rows, Prior(material, *kept.tolist()), _FULL, 1.0)
        assumed = np.zeros(PARAMETERS)  # the prior of the last fit comes from poses, unless these told little
        assumed[12:] = np.where(deviations > _LEARNED, first.assumed[12:], 0.0)
        return dataclasses.replace(last, assumed=assumed)

    def _by_pieces(self, prior: Prior) -> tuple[Material, np.ndarray] | None:
        """Material by short pieces of the track before its last poses, and its covariance. [2, 2]

        No simulation follows a long track with many impacts if the first of them is missed. None if none follows a
        piece either.
        """
        information = np.diag([prior.friction**-2.0, prior.restitution**-2.0])
        certain, pull, count = information.copy(), np.zeros(2), 0
        for stop in range(len(self.track) - LAST + 1, max(self.flight, LAST - 1), 1 - LAST):
            piece = self.track.rows(slice(stop - LAST, stop))
            found = self.fit(self.ballistic(piece.rows(slice(0, 2))), prior.material, piece, prior, _FULL, 1.0)
            if found.misfit < _FOLLOWED:
                told = np.linalg.inv(found.covariance[12:, 12:])
                certain, count = certain + told - information, count + 1
                pull += told @ (_logs(found.material) - _logs(prior.material))
        if not count:
            return None
        learned = np.linalg.inv(certain)
        return _material(*(_logs(prior.material) + learned @ pull).tolist()), learned

    def _last(self, whole: Estimate) -> tuple[Track, bool]:
        """Last poses, and True if the fit of all poses misses the first of them.

        If it misses those after an impact, the pose before the impact is left out.
        """
        first = max(len(self.track) - LAST, 0)
        missed = whole.squares[first:] > _MISSED
        if len(missed) == LAST and missed[1] and not missed[0]:
            first, missed = first + 1, missed[1:]
        return self.track.rows(slice(first, None)), bool(missed[0])

    def _touched(self) -> bool:
        return self.flight < len(self.track)

    def _whole(self, prior: Prior) -> Estimate:
        track, flight = self.track, self.flight if self.flight >= _LEAST_FLIGHT else min(3, len(self.track))
        start = self.ballistic(track.rows(slice(0, flight)))
        if not self._touched():
            return self.fit(start, prior.material, track, prior, _FULL)
        found, guesses = [], self._guesses(start)
        for fit in (self._direct, self._grown):
            for guess in guesses:
                found.append(fit(start, guess, prior))
                if found[-1].misfit < _GOOD:
                    return found[-1]
        best = min(found, key=lambda estimate: estimate.cost)
        return self._direct(best.state, best.material, prior)

    def _direct(self, start: State, guess: Material, prior: Prior) -> Estimate:
        """Fit all poses at once."""
        return self.fit(start, guess, self.track, prior, _FULL)

    def _grown(self, start: State, guess: Material, prior: Prior) -> Estimate:
        """Fit more and more poses."""
        count, flight, near = len(self.track), max(self.flight, 1), (start, guess)
        for rows in sorted({min(count, flight + 2), min(count, (flight + 2 + count) // 2)} - {count}):
            grown = self.fit(*near, self.track.rows(slice(0, rows)), prior, _EARLY)
            near = grown.state, grown.material
        return self._direct(*near, prior)

    def _guesses(self, start: State) -> list[Material]:
        """First guesses of the material: the one that follows most poses, and the one that misses none by much."""
        materials = [Material(mu, e) for mu in _FRICTIONS for e in _RESTITUTIONS]
        same = self._many_moved(start, materials[0], np.zeros((len(materials), PARAMETERS)))[0]
        missed = np.nan_to_num(self._residuals(same, materials, self.track), nan=1e9)
        squares = (missed**2).sum(axis=-1)
        losses = np.minimum(np.sqrt(squares), _LOST), robust_weights.cauchy_losses(squares, _OUTLIER)
        best = [int(np.argmin(loss.sum(axis=1))) for loss in losses]
        return [materials[k] for k in dict.fromkeys(best)]

    def fit(
        self, state: State, material: Material, track: Track, prior: Prior, steps: int, told: float | None = None
    ) -> Estimate:
        """Fit from a state at the time of the first pose of a track; None for ``told`` finds it by the residuals."""
        precision = np.append(np.zeros(12), [1 / prior.friction, 1 / prior.restitution])
        start, least = np.append(np.zeros(12), _logs(material) - _logs(prior.material)), np.inf

        def linearized(x: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal least
            here = self._residuals(*self._many_moved(state, prior.material, x), track)
            losses = robust_weights.cauchy_losses((here**2).sum(axis=-1), _OUTLIER)
            cost = float(losses.sum() + ((precision * x) ** 2).sum())
            if not cost <= least * (1 + 1e-9):  # the solver rejects the step
                return here, np.zeros((1, PARAMETERS, *here.shape[1:]))
            slopes = self._slopes(state, prior, track, x[0], here[0])
            if np.isfinite(slopes).all():  # else the solver rejects this step, too
                least = cost
            return here, slopes[None]

        found = levenberg_marquardt.solve_linearized(
            linearized, start[None], precision=precision, softness=_OUTLIER, steps=steps, enough=_NEGLIGIBLE
        ).row(0)
        moved, learned = self.moved(state, prior.material, found.x)
        residuals = found.residuals.reshape(2, len(track), 3)
        squares = (residuals**2).mean(axis=(0, 2))
        told = self._told(track, residuals) if told is None else told
        ridge = np.diag(1e-9 * np.maximum(np.diag(found.normal), 1e-9))
        information = told * found.normal + (1 - told) * np.diag(precision**2)
        return Estimate(
            moved,
            float(track.times[0]),
            learned,
            np.linalg.inv(information + ridge),
            precision**2,
            float(found.cost),
            float(squares.mean()),
            squares,
            told,
        )

    def _told(self, track: Track, residuals: np.ndarray) -> float:
        """Information of poses over that of independent ones with the assumed errors. [2, S, 3]"""
        rows = residuals[:, track.times >= self.track.times[min(self.flight, len(self.track) - 1)]]
        if rows.shape[1] < _REPEATED or not np.isfinite(rows).all():
            return 1.0
        power = max(float((rows**2).mean()), 1e-12)
        repeated = min(max(float((rows[:, 1:] * rows[:, :-1]).mean()) / power, 0.0), 1.0)
        return max((1 - repeated) / (1 + repeated) / max(power, 1.0), _LEAST_TOLD)

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
        self.simulation.set_materials(self._materials(estimate.material))
        self.simulation.load(self._all(estimate.state))
        return self.simulation.state_at(time - estimate.time).one(self.body)

    def poses(self, state: State, material: Material, times: np.ndarray) -> se3.Pose:
        """Poses of the body at times since a state. [T, 4], [T, 3]"""
        quats, places = self._many_poses(state.batch(), [material], times)
        return quats[0], places[0]

    def _many_poses(self, states: State, materials: Sequence[Material], times: np.ndarray) -> se3.Pose:
        """Poses of the body at times since each of N states. [N, T, 4], [N, T, 3]"""
        used = [self._materials(material) for material in materials]
        quats, places = self.simulation.paths(self._all(states), times, used)
        return quats[:, :, self.body], places[:, :, self.body]

    def residuals(self, state: State, material: Material, time: float) -> np.ndarray:
        """Differences from the observed poses from the time of a state on, in units of the noise. [2 S', 3]"""
        rows = slice(int(np.searchsorted(self.track.times, time)), None)
        return self._residuals(state.batch(), [material], self.track.rows(rows))[0]

    def ballistic(self, track: Track) -> State:
        """State at the first of at least two poses in free flight, by a parabola and a constant spin."""
        gravity = self.simulation.world.gravity
        t = track.times - track.times[0]
        columns = np.stack([np.ones_like(t), t], axis=1)
        place, velocity = np.linalg.lstsq(columns, track.places - 0.5 * gravity * t[:, None] ** 2, rcond=None)[0]
        known = track.turn_noise < UNKNOWN_TURN
        if known.sum() > 1:
            columns, t, quats = columns[known], t[known], track.quats[known]
        else:
            quats = track.quats
        steps = rotations.quats_to_rotvecs(rotations.multiply(quats[1:], rotations.conjugate(quats[:-1])))
        spin = np.median(steps / np.diff(t)[:, None], axis=0) if len(t) > 1 else np.zeros(3)
        quat = rotations.multiply(rotations.rotvecs_to_quats(-spin * t[0]), quats[0])
        for _ in range(5 if len(t) > 1 else 0):
            shown = rotations.multiply(rotations.rotvecs_to_quats(spin * t[:, None]), quat)
            missed = rotations.quats_to_rotvecs(rotations.multiply(quats, rotations.conjugate(shown)))
            turn, more = np.linalg.lstsq(columns, missed, rcond=None)[0]
            quat, spin = rotations.multiply(rotations.rotvecs_to_quats(turn), quat), spin + more
        return State(place[None], rotations.normalize(quat)[None], velocity[None], spin[None])

    def _flight(self) -> int:
        """Number of poses before the first that is close to the plane, or that follows an impact."""
        plane = self.simulation.world.plane
        if plane is None:
            return len(self.observed)
        body = self.simulation.world.bodies[self.body]
        gaps = worlds.gaps(body, plane, self.observed.places, self.observed.quats)
        close = gaps < _CLOSE * self.size
        if len(gaps) > 2:
            steps, drop = np.diff(self.observed.times), 0.5 * float(np.linalg.norm(self.simulation.world.gravity))
            speeds = np.diff(gaps)[:-1] / steps[:-1] - drop * steps[:-1]
            close[2:] |= gaps[1:-1] + speeds * steps[1:] - drop * steps[1:] ** 2 < 0
        return int(np.argmax(close)) if close.any() else len(self.observed)

    def _slopes(self, state: State, prior: Prior, track: Track, x: np.ndarray, here: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals ``here`` [2 S, 3] at parameters x [14]. [14, 2 S, 3]"""
        ahead = self._residuals(*self._many_moved(state, prior.material, x + np.diag(_STEPS)), track)
        return (ahead - here) / _STEPS[:, None, None]

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


def _logs(material: Material) -> np.ndarray:
    """Logarithm of the friction and logit of the restitution. [2]"""
    e = min(max(material.restitution, 1e-3), 1 - 1e-3)
    return np.array([np.log(max(material.friction, 1e-4)), np.log(e / (1 - e))])


def _material(log_friction: float, logit: float) -> Material:
    """Inverse of `_logs`."""
    return Material(float(np.exp(np.clip(log_friction, -12, 5))), float(1 / (1 + np.exp(-logit))))

"""First guesses of free parameters, from linear fits to a pose track. A guess maps blocks to values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import robust_weights, rotations
from ..pose_track import PoseTrack, Window

Guess = dict[str, np.ndarray]
TimeFactors = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
_PACES = 25  # number of tried frequencies
_PAIRED = 18  # the same for sums of two oscillations
_DECAYS = (0.3, 1.0, 2.5, 4.0)  # tried decay rates, per span
_STARTS = 2  # number of guesses that are refined
_GAIN = 9.0  # minimum gain of an oscillation over the simpler fit, in variances (three standard deviations)
_RIDGE = 1e-4  # on a centre of rotation, in radii


def least_squares(columns: np.ndarray, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted linear fit. [S, C], [S, n], [S] -> [C, n]"""
    root = np.sqrt(weights)[:, None]
    return np.linalg.lstsq(columns * root, values * root, rcond=None)[0]


def parabola(blocks: Sequence[str], track: PoseTrack) -> Guess:
    """Parabola through the displacements, and a line through the angular velocities."""
    tau, count = track.tau, len(track)
    degree = min(2 if "a" in blocks else 1, count - 1)
    powers = np.stack([tau**k / (1, 1, 2)[k] for k in range(degree + 1)], -1)
    line = least_squares(powers, track.displacements, track.weights)
    spin = track.spin
    guess = {"r": np.zeros(3), "e": line[0], "w": spin, "eps": np.zeros(3), "kappa": np.zeros(1), "u": np.zeros(3)}
    guess["v"] = line[1] if degree >= 1 else np.zeros(3)
    guess["a"] = line[2] if degree >= 2 else np.zeros(3)
    if "eps" in blocks and count >= 4:
        ones = np.ones_like(track.middles)
        trend = np.linalg.lstsq(np.stack([ones, track.middles], -1), track.spins, rcond=None)[0]
        guess["w"], guess["eps"] = trend[0], trend[1]
    if "u" in blocks and "v" not in blocks and degree >= 1:
        # The centre nearest to the pivot whose rotation gives the pivot's velocity: w x (-u) = v.
        guess["u"] = np.cross(spin, line[1]) / max(float(spin @ spin), 1e-6)
    return guess


def center(track: PoseTrack, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacement e and fixed point u of d = e + u - R u, which is linear in both. [3], [3]"""
    matrices = rotations.quats_to_rotmats(quats)
    columns = np.concatenate([np.broadcast_to(np.eye(3), (len(track), 3, 3)), np.eye(3) - matrices], -1)
    ridge = np.diag([0.0] * 3 + [_RIDGE] * 3)
    stacked = np.concatenate([columns.reshape(-1, 6), ridge])
    found = np.linalg.lstsq(stacked, np.r_[track.displacements.reshape(-1), np.zeros(6)], rcond=None)[0]
    return found[:3], found[3:]


@dataclass(frozen=True)
class _Sweep:
    """Linear fits of a path, one at each of F frequencies and decay rates.

    Attributes:
        frequencies: Tried frequencies. [F]
        decays: Tried decay rates. [F]
        rates: Position, velocity and acceleration at t_max. [F, 3, 3]
        misses: Remaining weighted sum of squares. [F]
        gain: Excess of the parabola's sum of squares over that of the best frequency, in residual variances of the
            latter.
    """

    frequencies: np.ndarray
    decays: np.ndarray
    rates: np.ndarray
    misses: np.ndarray
    gain: float


def _sweep(track: PoseTrack, path: np.ndarray, window: Window, time_factors: TimeFactors, damped: bool) -> _Sweep:
    """Fit a path at all frequencies in two rounds, the second with robust pose weights. path: [S, 3]"""
    grid = np.geomspace(window.low, window.high, _PACES)[1:-1]
    decays = np.array(_DECAYS if damped else [0.0])
    frequencies = np.r_[0.0, np.repeat(grid, len(decays))]
    rates_of_decay = np.r_[0.0, np.tile(decays, len(grid))]
    factors = time_factors(frequencies[:, None, None], track.tau[:, None], rates_of_decay[:, None, None])
    columns = np.concatenate([np.ones_like(factors[0]), *factors], axis=-1)

    def fit(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        root = np.sqrt(weights)[:, None]
        rates = np.linalg.pinv(columns * root) @ (path * root)
        sizes = ((columns @ rates - path) ** 2).sum(-1)
        return rates, sizes, (weights * sizes).sum(-1)

    _, sizes, misses = fit(track.weights)
    best = np.sqrt(sizes[1 + int(np.argmin(misses[1:]))])
    rates, _, misses = fit(robust_weights.reweight(track.weights, best, robust_weights.cauchy_scale(best, 1e-9)))
    least = float(misses[1:].min())
    gain = (float(misses[0]) - least) / max(least, 1e-18) * (3 * len(path) - 10 - damped)
    return _Sweep(frequencies[1:], rates_of_decay[1:], rates[1:], misses[1:], gain)


def oscillation_guesses(
    blocks: Sequence[str], track: PoseTrack, window: Window, time_factors: TimeFactors
) -> list[Guess]:
    """Guesses of a motion with a free frequency, most promising first; empty if no oscillation is found.

    They are the local minima of the misfit of the displacements or rotations over frequency. An oscillation is found if
    it fits one of these significantly better than a parabola.
    """
    if not window.may_swing:
        return []
    damped = "decay" in blocks
    sweeps = {"path": _sweep(track, track.displacements, window, time_factors, damped)}
    if "swing" in blocks:
        sweeps["turn"] = _sweep(track, track.accumulated_rotation, window, time_factors, damped)
    if max(sweep.gain for sweep in sweeps.values()) <= _GAIN:
        return []
    sweep = sweeps.get("turn", sweeps["path"])
    misses = sweep.misses.reshape(-1, len(_DECAYS) if damped else 1)
    padded = np.pad(misses.min(1), 1, constant_values=np.inf)
    valleys = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]))
    rows = valleys * misses.shape[1] + misses[valleys].argmin(1)
    best = rows[np.argsort(sweep.misses[rows], kind="stable")][:_STARTS]
    return [_swinging(blocks, track, window, sweep, int(i)) for i in best]


def _swinging(blocks: Sequence[str], track: PoseTrack, window: Window, sweep: _Sweep, row: int) -> Guess:
    """Guess from the rates of a fit at one frequency: position, velocity, acceleration at t_max."""
    rates, frequency, decay = sweep.rates[row], float(sweep.frequencies[row]), float(sweep.decays[row])
    guess = {
        "r": np.zeros(3),
        "e": rates[0],
        "v": rates[1],
        "a": rates[2],
        "pace": np.array([window.frequency_logit(frequency)]),
    }
    guess["decay"] = np.log(np.array([max(decay, 1e-2)]))
    if "swing" in blocks:
        # q exp(-c tau) sin(W tau + f) has the rates (W cos f - c sin f) q and ((c^2 - W^2) sin f - 2 c W cos f) q.
        rock = np.linalg.solve(
            [[frequency, -decay], [-2 * decay * frequency, decay**2 - frequency**2]], rates[1:]
        )  # q cos f, q sin f
        # Axis and phase nearest to both: the rank-one approximation of their matrix.
        left, sizes, right = np.linalg.svd(rock.T)
        guess["swing"], guess["phase"] = left[:, 0] * sizes[0], np.array([np.arctan2(right[0, 1], right[0, 0])])
        guess["e"], guess["u"] = center(track, track.quats)
    return guess


def two_oscillation_guesses(track: PoseTrack, window: Window, time_factors: TimeFactors) -> list[Guess]:
    """Guesses of a sum of two oscillations of positions and rotations, most promising first.

    Empty if no pair of frequencies fits significantly better than the best single frequency.
    """
    if not window.may_swing or len(track) < 10:
        return []
    grid = np.geomspace(window.low, window.high, _PAIRED + 2)[1:-1]
    once, twice = time_factors(grid[:, None, None], track.tau[:, None], np.zeros(1))
    columns = np.concatenate([once, twice], -1)  # [F, S, 2]
    i, j = np.triu_indices(_PAIRED, 2)
    ones = np.ones((len(i), len(track), 1))
    both = np.concatenate([ones, columns[i], columns[j]], -1)
    path = np.concatenate([track.displacements, track.accumulated_rotation - track.accumulated_rotation[-1]], -1)
    normal = both.swapaxes(1, 2) @ both
    normal += _RIDGE**2 * np.eye(5) * np.einsum("kii->k", normal)[:, None, None]
    fits = np.linalg.solve(normal, both.swapaxes(1, 2) @ path)
    misses = ((both @ fits - path) ** 2).sum((-1, -2))
    single = np.concatenate([ones[:_PAIRED], columns], -1)
    alone = float(((single @ (np.linalg.pinv(single) @ path) - path) ** 2).sum((-1, -2)).min())
    best = np.argsort(misses, kind="stable")
    if (alone - misses[best[0]]) / max(misses[best[0]], 1e-18) * (6 * len(track) - 32) <= _GAIN:
        return []
    rows, found = [], []
    for row in best:
        if all(abs(i[row] - i[k]) + abs(j[row] - j[k]) > 1 for k in rows):
            rows.append(row)
        if len(rows) == 2 * _STARTS:
            break
    for row in rows:
        e, v, a, v2, a2 = fits[row, :, :3]
        _, w, eps, w2, eps2 = fits[row, :, 3:]
        paces = (np.array([window.frequency_logit(float(grid[k[row]]))]) for k in (i, j))
        guess = dict(zip(("pace", "pace2"), paces, strict=True))
        found.append(guess | {"r": np.zeros(3), "e": e, "v": v, "a": a, "v2": v2, "a2": a2})
        found[-1] |= {"w": w, "eps": eps, "w2": w2, "eps2": eps2}
    return found

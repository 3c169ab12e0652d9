"""Candidate motion families for `model_selection`, and their robust least-squares fit to a pose track.

All quantities are dimensionless: times in units of the observed span and zero at t_max, lengths in units of the group's
radius. A candidate is a list of free blocks; the pose at t_max (r, e of `models`) is always free. Notation: S poses, P
parameters, B parameter vectors evaluated at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..motion import levenberg_marquardt, models, robust_weights, rotations, se3

_SIZES = {"r": 3, "e": 3, "v": 3, "a": 3, "w": 3, "eps": 3, "kappa": 1, "u": 3, "swing": 3, "phase": 1, "pace": 1}
# Standard deviations of weak priors, in radii and spans, far wider than observed motions. They only constrain
# directions that the poses leave undetermined (a centre along its own axis, the centre of a body that does not rotate).
_PRIORS = {"a": 100.0, "eps": 100.0, "kappa": 30.0, "u": 10.0, "swing": 10.0, "phase": 10.0, "pace": 5.0}
_PACES = 25  # number of frequencies tried for an initial guess
_STARTS = 2  # number of these that are refined
_GAIN = 9.0  # required gain of an oscillation over a parabola, in residual variances (9 = three standard deviations)


@dataclass(frozen=True)
class Candidate:
    """A family of motions.

    Attributes:
        name: Name in the score table.
        kind: Kind of the resulting `models.MotionModel`.
        blocks: Free blocks besides the pose at t_max: "v", "a", "w", "eps", "u" as in `models`; "kappa" is the relative
            rate of a spin about a fixed axis: w(tau) = w_mid (1 + kappa (tau - tau_mid)). "swing" q and "phase" f are
            an angle about a fixed axis, q sin(W tau + f), which stays determined if w or eps is zero; "pace" is the
            logit of W in `frequencies`.
        tau_mid: Middle of the window, for "kappa".
        frequencies: Lowest and highest W of a motion with "pace". Less than a quarter period in the window cannot be
            distinguished from a constant acceleration.
        inertia: Inertia in the bind state, for kinds that need it. [3, 3]
    """

    name: str
    kind: str
    blocks: tuple[str, ...]
    tau_mid: float = -0.5
    frequencies: tuple[float, float] = (0.5 * np.pi, 8 * np.pi)
    inertia: np.ndarray | None = field(default=None, compare=False)

    @property
    def parameters(self) -> int:
        """Number of free parameters, including the six of the pose at t_max."""
        return 6 + sum(_SIZES[b] for b in self.blocks)

    def unpack(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """Vectors r, e, v, a, w, eps, u [B, 3] and frequency [B, 1] of parameters [B, P]; zero if not free."""
        parts = {name: np.zeros((*theta.shape[:-1], 3)) for name in ("r", "e", "v", "a", "w", "eps", "u")}
        parts["frequency"] = np.zeros((*theta.shape[:-1], 1))
        start = 0
        for block in ("r", "e", *self.blocks):
            stop = start + _SIZES[block]
            parts[block] = theta[..., start:stop]
            start = stop
        if "kappa" in parts:
            kappa, w_mid = parts.pop("kappa"), parts["w"]
            parts["eps"] = kappa * w_mid
            parts["w"] = w_mid * (1 - kappa * self.tau_mid)
        if "pace" in parts:
            low, high = self.frequencies
            parts["frequency"] = low + (high - low) / (1 + np.exp(-np.clip(parts.pop("pace"), -30, 30)))
        if "swing" in parts:
            swing, phase, frequency = parts.pop("swing"), parts.pop("phase"), parts["frequency"]
            parts["w"], parts["eps"] = swing * np.cos(phase) * frequency, -swing * np.sin(phase) * frequency**2
        return parts

    @property
    def oscillates(self) -> bool:
        """True if a frequency is free."""
        return "pace" in self.blocks

    def index(self, block: str) -> int:
        """Index of a free block's first parameter."""
        free = ("r", "e", *self.blocks)
        return sum(_SIZES[b] for b in free[: free.index(block)])

    def pace(self, frequency: float) -> float:
        """Value of the parameter "pace" for a frequency between the lowest and the highest."""
        low, high = self.frequencies
        share = min(max((frequency - low) / (high - low), 1e-3), 1 - 1e-3)
        return float(np.log(share / (1 - share)))

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the fitted curve. [B, P], [S] -> quaternions [B, S, 4], displacements [B, S, 3]"""
        p = {name: part[..., None, :] for name, part in self.unpack(theta).items()}
        rates = models.Rates(p["v"], p["a"], p["w"], p["eps"], p["u"], p["frequency"])
        return models.KINDS[self.kind].fitted(rates, p["r"], p["e"], tau, self.inertia)


# Ordered by number of parameters; with equal numbers, motions without oscillation first, then in the order of `_NAMES`.
ALL = sorted(
    (Candidate(name, kind, fit) for kind in models.KINDS for name, fit in models.KINDS[kind].fits.items()),
    key=lambda candidate: (candidate.parameters, candidate.oscillates),
)
FAMILY = tuple(candidate for candidate in ALL if models.KINDS[candidate.kind].fits_by_default)
BY_NAME = {candidate.name: candidate for candidate in ALL}
FREE_TOP = BY_NAME["free top"]


@dataclass(frozen=True)
class Track:
    """Dimensionless observations.

    Attributes:
        tau: Times, <= 0 at t_max or before. [S]
        quats: Unit wxyz relative to the bind state. [S, 4]
        displacements: Displacements of the pivot. [S, 3]
        weights: Pose weights, > 0. [S]
    """

    tau: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    weights: np.ndarray

    def rows(self, index: np.ndarray | slice) -> Track:
        """Select poses by index."""
        return Track(self.tau[index], self.quats[index], self.displacements[index], self.weights[index])


@dataclass(frozen=True)
class Solution:
    """A fitted candidate.

    Attributes:
        candidate: The candidate.
        theta: Parameters. [P]
        robust: Robust weights of the poses, in [0, 1]. [S]
        normal: Normal matrix of the weighted scaled residuals, priors included. [P, P]
        chi2: Weighted mean of the squared scaled residuals per component.
    """

    candidate: Candidate
    theta: np.ndarray
    robust: np.ndarray
    normal: np.ndarray
    chi2: float


def residuals(candidate: Candidate, theta: np.ndarray, track: Track, sigmas: tuple[float, float]) -> np.ndarray:
    """Displacement and rotation errors in units of their noise (sigma_t, sigma_r). [B, P] -> [B, S, 6]"""
    return se3.differences((track.quats, track.displacements), candidate.poses(theta, track.tau), *sigmas)


def start(candidate: Candidate, track: Track) -> np.ndarray:
    """Initial guess from a parabola through the displacements and the rotations between neighbouring poses. [P]"""
    tau, s = track.tau, len(track.tau)
    degree = min(2 if "a" in candidate.blocks else 1, s - 1)
    powers = np.stack([tau**k / (1, 1, 2)[k] for k in range(degree + 1)], -1)
    root = np.sqrt(track.weights)[:, None]
    line = np.linalg.lstsq(powers * root, track.displacements * root, rcond=None)[0]
    steps = np.diff(tau)
    turns = rotations.quats_to_rotvecs(rotations.multiply(track.quats[1:], rotations.conjugate(track.quats[:-1])))
    rates = turns / steps[:, None]
    spin = np.median(rates, axis=0) if len(rates) else np.zeros(3)
    guesses = {"r": np.zeros(3), "e": line[0], "w": spin, "eps": np.zeros(3), "kappa": np.zeros(1), "u": np.zeros(3)}
    guesses["v"] = line[1] if degree >= 1 else np.zeros(3)
    guesses["a"] = line[2] if degree >= 2 else np.zeros(3)
    if "eps" in candidate.blocks and len(rates) >= 3:
        middles = 0.5 * (tau[1:] + tau[:-1])
        trend = np.linalg.lstsq(np.stack([np.ones_like(middles), middles], -1), rates, rcond=None)[0]
        guesses["w"], guesses["eps"] = trend[0], trend[1]
    if "u" in candidate.blocks and "v" not in candidate.blocks:
        # The centre nearest to the pivot whose rotation gives the pivot's velocity: w x (-u) = v.
        guesses["u"] = np.cross(spin, line[1]) / max(float(spin @ spin), 1e-6) if degree >= 1 else np.zeros(3)
    return np.concatenate([guesses[b] for b in ("r", "e", *candidate.blocks)])


@dataclass(frozen=True)
class _Sweep:
    """Linear fits of a path, one at each of F frequencies.

    Attributes:
        frequencies: Tried frequencies. [F]
        rates: Position, velocity and acceleration at t_max. [F, 3, 3]
        misses: Remaining weighted sum of squares. [F]
        gain: Sum of squares of the parabola minus that of the best frequency, in residual variances of the latter.
    """

    frequencies: np.ndarray
    rates: np.ndarray
    misses: np.ndarray
    gain: float


def _sweep(candidate: Candidate, track: Track, path: np.ndarray) -> _Sweep:
    """Fit a path at all frequencies in two rounds, the second with robust pose weights as in `solve`. path: [S, 3]"""
    frequencies = np.r_[0.0, np.geomspace(*candidate.frequencies, _PACES)[1:-1]]
    clocks = models.clocks(frequencies[:, None, None], track.tau[:, None])
    columns = np.concatenate([np.ones_like(clocks[0]), *clocks], axis=-1)

    def fit(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        root = np.sqrt(weights)[:, None]
        rates = np.linalg.pinv(columns * root) @ (path * root)
        sizes = ((columns @ rates - path) ** 2).sum(-1)
        return rates, sizes, (weights * sizes).sum(-1)

    _, sizes, misses = fit(track.weights)
    best = np.sqrt(sizes[1 + int(np.argmin(misses[1:]))])
    rates, _, misses = fit(robust_weights.reweight(track.weights, best, robust_weights.cauchy_scale(best, 1e-9)))
    least = float(misses[1:].min())
    gain = (float(misses[0]) - least) / max(least, 1e-18) * (3 * len(path) - 10)
    return _Sweep(frequencies[1:], rates[1:], misses[1:], gain)


def _turned(track: Track) -> np.ndarray:
    """Cumulative sum of the rotations between neighbours: an unwrapped rotation vector if the axis is fixed. [S, 3]"""
    turns = rotations.quats_to_rotvecs(rotations.multiply(track.quats[1:], rotations.conjugate(track.quats[:-1])))
    return np.concatenate([np.zeros((1, 3)), np.cumsum(turns, axis=0)])


def may_swing(candidate: Candidate, track: Track) -> bool:
    """Return True if an oscillation fits the rotations or displacements significantly better than a parabola."""
    paths = [track.displacements] + ([_turned(track)] if "swing" in candidate.blocks else [])
    return any(_sweep(candidate, track, path).gain > _GAIN for path in paths)


def swinging_starts(candidate: Candidate, track: Track) -> list[np.ndarray]:
    """Initial guesses of a motion with a free frequency, most promising first. [P] each

    They are the local minima of the misfit of the displacements or rotations over frequency.
    """
    path = _turned(track) if "swing" in candidate.blocks else track.displacements
    sweep = _sweep(candidate, track, path)
    padded = np.pad(sweep.misses, 1, constant_values=np.inf)
    valleys = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]))
    best = valleys[np.argsort(sweep.misses[valleys], kind="stable")][:_STARTS]
    return [_swinging(candidate, track, float(sweep.frequencies[i]), sweep.rates[i]) for i in best]


def _swinging(candidate: Candidate, track: Track, frequency: float, rates: np.ndarray) -> np.ndarray:
    """Parameters from the rates of a fit at one frequency: position, velocity, acceleration at t_max. [3, 3] -> [P]"""
    guesses = {"r": np.zeros(3), "e": rates[0], "v": rates[1], "a": rates[2], "pace": candidate.pace(frequency)}
    if "swing" in candidate.blocks:
        # Axis and phase nearest to both rates: the rank-one approximation of their matrix.
        left, sizes, right = np.linalg.svd(np.stack([rates[1] / frequency, -rates[2] / frequency**2]).T)
        guesses["swing"] = left[:, 0] * sizes[0]
        guesses["phase"] = np.arctan2(right[0, 1], right[0, 0])
        matrices = rotations.quats_to_rotmats(track.quats)
        # d = e + u - R u is linear in e and u.
        columns = np.concatenate([np.broadcast_to(np.eye(3), (len(track.tau), 3, 3)), np.eye(3) - matrices], -1)
        ridge = np.diag([0.0] * 3 + [1 / _PRIORS["u"]] * 3) * 1e-3
        stacked = np.concatenate([columns.reshape(-1, 6), ridge])
        right_side = np.concatenate([track.displacements.reshape(-1), np.zeros(6)])
        solution = np.linalg.lstsq(stacked, right_side, rcond=None)[0]
        guesses["e"], guesses["u"] = solution[:3], solution[3:]
    return np.concatenate([np.atleast_1d(guesses[b]) for b in ("r", "e", *candidate.blocks)])


def solve(candidate: Candidate, track: Track, sigmas: tuple[float, float], first: np.ndarray | None = None) -> Solution:
    """Fit a candidate to poses, robustly.

    Args:
        candidate: The family.
        track: The poses.
        sigmas: Noise of displacements (radii) and rotations (rad), which sets their relative weight.
        first: Initial guess, or None for `start`; with a free frequency, for the best of `swinging_starts`. [P]
    """
    if first is None and candidate.oscillates:
        solutions = [solve(candidate, track, sigmas, guess) for guess in swinging_starts(candidate, track)]
        return min(solutions, key=lambda solution: solution.chi2)
    found = levenberg_marquardt.solve(
        lambda batch: residuals(candidate, batch, track, sigmas),
        start(candidate, track) if first is None else first,
        weights=track.weights,
        precision=_prior_precision(candidate),
        robust=True,
    )
    weights = track.weights * found.robust
    chi2 = float((weights[:, None] * found.residuals**2).sum() / (6 * weights.sum()))
    return Solution(candidate, found.x, found.robust, found.normal, chi2)


def _prior_precision(candidate: Candidate) -> np.ndarray:
    """Inverse standard deviations of the weak priors. [P]"""
    parts = [np.full(_SIZES[b], 1 / _PRIORS[b] if b in _PRIORS else 0.0) for b in ("r", "e", *candidate.blocks)]
    return np.concatenate(parts)

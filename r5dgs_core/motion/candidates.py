"""The families of motion that `fitting` chooses from, and their robust least-squares fit to a pose track.

Everything here is dimensionless: times in units of the observed span and zero at t_max, lengths in units of the group's
radius. A candidate is a list of free blocks; the pose at t_max (r, e of `models`) is always free. Notation: S poses,
P parameters, B parameter vectors evaluated at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import models, rotations, se3

_SIZES = {"r": 3, "e": 3, "v": 3, "a": 3, "w": 3, "eps": 3, "kappa": 1, "u": 3}
# Priors as standard deviations, in radii and spans: far wider than what observed motions show; they only close
# directions that the poses leave open (a centre along its own axis, the centre of a body that does not turn).
_PRIORS = {"a": 100.0, "eps": 100.0, "kappa": 30.0, "u": 10.0}
_DIFFERENCE = 1e-5
_STEPS = 30
_STEPS_AGAIN = 4  # per round of reweighting, which starts near its end
_ROUNDS = 8


@dataclass(frozen=True)
class Candidate:
    """A family of motions.

    Attributes:
        name: As in the score table.
        kind: Kind of `models.MotionModel` that it becomes.
        blocks: Free blocks besides the pose at t_max: "v", "a", "w", "eps", "u" as in `models`; "kappa" is the relative
            rate of a spin about a fixed axis: w(tau) = w_mid (1 + kappa (tau - tau_mid)).
        tau_mid: Middle of the window, for "kappa".
    """

    name: str
    kind: str
    blocks: tuple[str, ...]
    tau_mid: float = -0.5

    @property
    def parameters(self) -> int:
        """Free parameters, the six of the pose at t_max included."""
        return 6 + sum(_SIZES[b] for b in self.blocks)

    def unpack(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """Vectors r, e, v, a, w, eps, u of parameter vectors; zero where not free. [B, P] -> [B, 3] each"""
        parts = {name: np.zeros((*theta.shape[:-1], 3)) for name in ("r", "e", "v", "a", "w", "eps", "u")}
        start = 0
        for block in ("r", "e", *self.blocks):
            stop = start + _SIZES[block]
            parts[block] = theta[..., start:stop]
            start = stop
        if "kappa" in parts:
            kappa, w_mid = parts.pop("kappa"), parts["w"]
            parts["eps"] = kappa * w_mid
            parts["w"] = w_mid * (1 - kappa * self.tau_mid)
        return parts

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the fitted curve. [B, P], [S] -> quaternions [B, S, 4], displacements [B, S, 3]"""
        p = {name: part[..., None, :] for name, part in self.unpack(theta).items()}
        span = tau[:, None]
        if self.kind == "constant_twist":
            quats, d = models.twist_poses(p["v"], p["w"], span)
        elif self.kind == "world_twist":
            quats, d = _world_twist(p, tau)
        else:
            quats, d = models.spin_poses(p["v"], p["a"], p["w"], p["eps"], p["u"], span)
        return rotations.multiply(quats, rotations.rotvecs_to_quats(p["r"])), d + p["e"]


def _world_twist(p: dict[str, np.ndarray], tau: np.ndarray) -> se3.Pose:
    """Sixteen Magnus-4 steps over each time: enough to tell candidates apart; evaluation chooses its own steps."""
    steps = 16
    h = (tau / steps)[:, None]
    middles = np.arange(steps)[:, None, None, None] + 0.5
    mw, mv = p["w"] + middles * h * p["eps"], p["v"] + middles * h * p["a"]
    bracket = (rotations.cross(mw, p["eps"]), rotations.cross(mw, p["a"]) - rotations.cross(p["eps"], mv))
    return se3.product(*se3.exp(h * mw - h**3 / 12 * bracket[0], h * mv - h**3 / 12 * bracket[1]))


# Ordered by the number of parameters, the plainer motion first where it is equal.
FAMILY = (
    Candidate("static", "static", ()),
    Candidate("translation", "translation", ("v",)),
    Candidate("spin", "ballistic_spin", ("w",)),
    Candidate("spin, accelerating", "ballistic_spin", ("w", "kappa")),
    Candidate("translation, quadratic", "translation", ("v", "a")),
    Candidate("translation + spin", "ballistic_spin", ("v", "w")),
    Candidate("constant twist", "constant_twist", ("v", "w")),
    Candidate("hinge", "ballistic_spin", ("w", "kappa", "u")),
    Candidate("ballistic + spin", "ballistic_spin", ("v", "a", "w")),
    Candidate("ballistic + spin, accelerating", "ballistic_spin", ("v", "a", "w", "kappa")),
    Candidate("ballistic + spin, free axis", "ballistic_spin", ("v", "a", "w", "eps")),
    Candidate("ballistic + spin, free centre", "ballistic_spin", ("v", "a", "w", "u")),
    Candidate("full, free centre", "ballistic_spin", ("v", "a", "w", "eps", "u")),
)
EXTRA = (Candidate("world twist", "world_twist", ("v", "a", "w", "eps")),)
BY_NAME = {candidate.name: candidate for candidate in (*FAMILY, *EXTRA)}


@dataclass(frozen=True)
class Track:
    """Dimensionless observations.

    Attributes:
        tau: Times, <= 0 at t_max or before. [S]
        quats: Unit wxyz relative to the bind state. [S, 4]
        displacements: Of the pivot. [S, 3]
        weights: Of the poses, > 0. [S]
    """

    tau: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    weights: np.ndarray

    def rows(self, index: np.ndarray | slice) -> Track:
        """The poses with these indices."""
        return Track(self.tau[index], self.quats[index], self.displacements[index], self.weights[index])


@dataclass(frozen=True)
class Solution:
    """A fitted candidate.

    Attributes:
        candidate: Which.
        theta: Parameters. [P]
        robust: Weights that the loss gave to the poses, in [0, 1]. [S]
        jacobian: Of the scaled residuals, weighted, priors included. [6 S + P, P]
        chi2: Weighted mean of the squared scaled residuals per component.
    """

    candidate: Candidate
    theta: np.ndarray
    robust: np.ndarray
    jacobian: np.ndarray
    chi2: float


def residuals(candidate: Candidate, theta: np.ndarray, track: Track, sigmas: tuple[float, float]) -> np.ndarray:
    """Displacement and rotation errors in units of their noise (sigma_t, sigma_r). [B, P] -> [B, S, 6]"""
    quats, displacements = candidate.poses(theta, track.tau)
    turn = rotations.quats_to_rotvecs(rotations.multiply(track.quats, rotations.conjugate(quats)))
    return np.concatenate([(track.displacements - displacements) / sigmas[0], turn / sigmas[1]], axis=-1)


def start(candidate: Candidate, track: Track) -> np.ndarray:
    """First guess: the displacements' parabola and the turns between neighbours. [P]"""
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
        # The axis nearest to the pivot about which its velocity is a turn: w x (-u) = v.
        guesses["u"] = np.cross(spin, line[1]) / max(float(spin @ spin), 1e-6) if degree >= 1 else np.zeros(3)
    return np.concatenate([guesses[b] for b in ("r", "e", *candidate.blocks)])


def solve(candidate: Candidate, track: Track, sigmas: tuple[float, float], first: np.ndarray | None = None) -> Solution:
    """Fit by Levenberg-Marquardt under a Cauchy loss.

    Args:
        candidate: The family.
        track: The poses.
        sigmas: Noise of displacements (radii) and rotations (rad): sets their relative weight.
        first: First guess, or None for `start`. [P]

    Returns:
        The solution. Weights per pose are 1 / (1 + (rho / c)^2), rho the root mean square of its six scaled residuals
        and c twice 1.4826 times their median; no reweighting where the largest is under four medians.
    """
    theta = start(candidate, track) if first is None else first
    precision = _prior_precision(candidate)
    robust = np.ones(len(track.tau))
    theta, values, jacobian = _levenberg(candidate, track, sigmas, theta, robust, precision, _STEPS)
    for _ in range(_ROUNDS):
        size = np.sqrt((values**2).mean(-1))
        scale = 2 * 1.4826 * float(np.median(size))
        if size.max() <= 4 * float(np.median(size)) or size.max() < 1e-6:
            break
        updated = 1 / (1 + (size / max(scale, 1e-9)) ** 2)
        settled = np.abs(updated - robust).max() < 1e-3
        robust = updated
        theta, values, jacobian = _levenberg(candidate, track, sigmas, theta, robust, precision, _STEPS_AGAIN)
        if settled:
            break
    weights = track.weights * robust
    chi2 = float((weights[:, None] * values**2).sum() / (6 * weights.sum()))
    return Solution(candidate, theta, robust, jacobian, chi2)


def _prior_precision(candidate: Candidate) -> np.ndarray:
    """Inverse standard deviation of the weak priors. [P]"""
    parts = [np.full(_SIZES[b], 1 / _PRIORS[b] if b in _PRIORS else 0.0) for b in ("r", "e", *candidate.blocks)]
    return np.concatenate(parts)


def _levenberg(
    candidate: Candidate,
    track: Track,
    sigmas: tuple[float, float],
    theta: np.ndarray,
    robust: np.ndarray,
    precision: np.ndarray,
    steps: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minimise for fixed weights; returns parameters [P], unweighted residuals [S, 6] and the Jacobian."""
    count = len(theta)
    root = np.sqrt(track.weights * robust)[:, None]
    offsets = np.concatenate([np.zeros((1, count)), _DIFFERENCE * np.eye(count), -_DIFFERENCE * np.eye(count)])
    damping = 1e-4
    values = residuals(candidate, theta[None], track, sigmas)[0]
    cost = float(((root * values) ** 2).sum() + ((precision * theta) ** 2).sum())
    jacobian = np.zeros((values.size + count, count))
    for _ in range(steps):
        batch = residuals(candidate, theta + offsets, track, sigmas)
        slopes = (batch[1 : count + 1] - batch[count + 1 :]) / (2 * _DIFFERENCE)
        jacobian = np.concatenate([(slopes * root).reshape(count, -1).T, np.diag(precision)])
        right = -jacobian.T @ np.concatenate([(root * batch[0]).reshape(-1), precision * theta])
        normal = jacobian.T @ jacobian
        diagonal = np.diag(normal) + 1e-12 * max(float(np.trace(normal)), 1e-300)
        gain, size = -1.0, 0.0
        for _ in range(8):
            step = np.linalg.solve(normal + np.diag(damping * diagonal), right)
            trial = residuals(candidate, (theta + step)[None], track, sigmas)[0]
            trial_cost = float(((root * trial) ** 2).sum() + ((precision * (theta + step)) ** 2).sum())
            if np.isfinite(trial_cost) and trial_cost <= cost:
                gain, size = cost - trial_cost, float(np.abs(step).max())
                theta, values, cost = theta + step, trial, trial_cost
                break
            damping = min(damping * 10, 1e12)
        damping = max(damping * 0.1, 1e-12)
        if gain <= 1e-6 * cost or size < 1e-12:
            break
    return theta, values, jacobian

"""Candidate motion laws of `model_selection`, and their robust least-squares fits to a pose track.

All quantities are dimensionless: times in units of the observed span and zero at t_max, lengths in units of the group's
radius. A candidate is a list of free blocks; the pose at t_max (r, e of `models`) is always free. Notation: S poses, P
parameters, B starts, K parameter vectors.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..motion import levenberg_marquardt, models, robust_weights, se3
from ..motion.models import Rates
from ..motion.models.first_guesses import Guess
from ..motion.pose_track import PoseTrack, Window

SOFTNESS = 24.0  # squared residual of a pose, in variances of its six numbers, at which its weight is one half
HOPELESS_LOSS = 400.0  # excess over the best loss above which a fit may end early
_ENOUGH = 0.02  # gain of a step, in variances, below which a fit is good enough to compare candidates


@dataclass(frozen=True)
class Candidate:
    """A family of motions.

    Attributes:
        name: Name in the score table.
        kind: Kind of the resulting `models.MotionModel`.
        blocks: Free blocks besides the pose at t_max, see `MotionKind.rates`.
        window: Times that the values of blocks refer to.
        inertia: Inertia in the bind state, for kinds that need it. [3, 3]
    """

    name: str
    kind: str
    blocks: tuple[str, ...]
    window: Window = Window()
    inertia: np.ndarray | None = field(default=None, compare=False)

    @property
    def parameters(self) -> int:
        """Number of free parameters, including the six of the pose at t_max."""
        return 6 + sum(self._block(name).size for name in self.blocks)

    @property
    def discrete_choices(self) -> int:
        """Number of discrete choices among the poses, such as the gap of a break."""
        return 0

    @property
    def poses_with_choices(self) -> int:
        """Number of poses, from the first one, that suffice to determine all discrete choices."""
        return 0

    @property
    def law(self) -> Candidate:
        """Candidate of the motion past t_max."""
        return self

    def law_parameters(self, theta: np.ndarray) -> np.ndarray:
        """Parameters of `law`. [..., P] -> [..., P']"""
        return theta

    def slip(self, theta: np.ndarray) -> np.ndarray:
        """Turn by which the last observed pose is wrong, in the body's frame. [P] -> [3]"""
        return np.zeros(3)

    @property
    def slip_times(self) -> tuple[float, ...]:
        """Times at which the observed rotation slips."""
        return ()

    @property
    def slipped(self) -> tuple[float, float] | None:
        """Times between which observed rotations are wrong, infinite at an end of the track; None if none is."""
        return None

    @property
    def oscillates(self) -> bool:
        """True if a frequency is free."""
        return "pace" in self.blocks

    def _block(self, name: str) -> models.Block:
        own = models.KINDS[self.kind].blocks
        return own[name] if name in own else models.BLOCKS[name]

    @functools.cached_property
    def precision(self) -> np.ndarray:
        """Inverse standard deviations of the weak priors. [P]"""
        blocks = [self._block(name) for name in ("r", "e", *self.blocks)]
        return np.concatenate([np.full(block.size, 1 / block.prior) for block in blocks])

    def parts(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the blocks. [..., P] -> [..., size] each"""
        found, start = {}, 0
        for name in ("r", "e", *self.blocks):
            stop = start + self._block(name).size
            found[name] = theta[..., start:stop]
            start = stop
        return found

    @functools.cached_property
    def rows(self) -> dict[str, np.ndarray]:
        """Indices of the parameters of the blocks. [size] each"""
        return self.parts(np.arange(self.parameters))

    def pack(self, guess: Mapping[str, np.ndarray]) -> np.ndarray:
        """Parameters from values of the blocks. [P]"""
        names = ("r", "e", *self.blocks)
        if missing := [name for name in names if name not in guess]:
            raise ValueError(f"candidate {self.name!r}: starts() gives no value for the block {missing[0]!r}")
        return np.concatenate([guess[name] for name in names])

    def rates(self, theta: np.ndarray) -> Rates:
        """Rates at t_max. [..., P] -> [..., 3], [..., 1]"""
        return models.KINDS[self.kind].rates(self.parts(theta), self.window)

    def poses(self, theta: np.ndarray, tau: np.ndarray) -> se3.Pose:
        """Poses of the fitted curve. [..., P], [S] -> quaternions [..., S, 4], displacements [..., S, 3]"""
        parts = {name: part[..., None, :] for name, part in self.parts(theta).items()}
        return models.KINDS[self.kind].observed(parts, tau, self.window, self.inertia)

    def path(self, theta: np.ndarray, tau: np.ndarray) -> se3.Pose:
        """Poses of one parameter vector. [P], [S] -> quaternions [S, 4], displacements [S, 3]"""
        quats, displacements = self.poses(theta[None], tau)
        return quats[0], displacements[0]

    def starts(self, track: PoseTrack) -> list[np.ndarray]:
        """First guesses; empty if the candidate cannot apply. [P] each"""
        guesses: list[Guess] = models.KINDS[self.kind].starts(self.blocks, track, self.window)
        return [self.pack(guess) for guess in guesses]

    def events(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Kinds and times of the events in the window. [P]"""
        return models.KINDS[self.kind].events(self.parts(theta), self.window)


# Ordered by number of parameters; with equal numbers, motions without oscillation first, then in the order of
# `models.KINDS` and their `fits`.
ALL = sorted(
    (Candidate(name, kind, fit) for kind in models.KINDS for name, fit in models.KINDS[kind].fits.items()),
    key=lambda candidate: (candidate.parameters, candidate.oscillates),
)
FAMILY = tuple(candidate for candidate in ALL if models.KINDS[candidate.kind].fits_by_default)
BY_NAME = {candidate.name: candidate for candidate in ALL}
PLAIN = tuple(c.name for c in ALL if c.name in models.KINDS[c.kind].plain_fits)
FREE_TOP = BY_NAME["free top"]
STATIC = BY_NAME["static"]


@dataclass(frozen=True)
class Noise:
    """Noise of a track per component: positions in radii, rotations in rad."""

    place: float
    turn: float

    def scaled(self, place: float, turn: float) -> Noise:
        """Noise with other levels."""
        return replace(self, place=self.place * place, turn=self.turn * turn)


@dataclass(frozen=True)
class FittedCandidate:
    """A fitted candidate.

    Attributes:
        candidate: The candidate.
        theta: Parameters. [P]
        normal: Normal matrix of the weighted scaled residuals, priors included. [P, P]
        residuals: Displacement and rotation errors in units of their noise. [S, 6]
        weights: Weights of the poses in the track. [S]
    """

    candidate: Candidate
    theta: np.ndarray
    normal: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray

    @functools.cached_property
    def squares(self) -> np.ndarray:
        """Squared lengths of the residuals. [S]"""
        return (self.residuals**2).sum(-1)

    @functools.cached_property
    def losses(self) -> np.ndarray:
        """Cauchy losses of the poses. [S]"""
        return self.weights * SOFTNESS * np.log1p(self.squares / SOFTNESS)

    @functools.cached_property
    def loss(self) -> float:
        """Sum of the losses."""
        return float(self.losses.sum())

    @property
    def robust(self) -> np.ndarray:
        """Robust weights of the poses, in [0, 1]. [S]"""
        return robust_weights.cauchy_weights(self.squares, SOFTNESS)

    @property
    def parameters(self) -> int:
        """Number of free parameters."""
        return self.candidate.parameters

    @functools.cached_property
    def inverse(self) -> np.ndarray:
        """Covariance of the parameters for residuals of unit variance. [P, P]"""
        return np.linalg.pinv(self.normal, hermitian=True)

    @functools.cached_property
    def law_slopes(self) -> np.ndarray:
        """Derivatives of the law's parameters with respect to those of the candidate. [P', P]"""
        if self.candidate.law is self.candidate:
            return np.eye(len(self.theta))
        step = 1e-6
        moved = self.candidate.law_parameters(self.theta + step * np.eye(len(self.theta)))
        return (moved - self.law_theta).T / step

    @functools.cached_property
    def law_theta(self) -> np.ndarray:
        """Parameters of the law past t_max. [P']"""
        return self.candidate.law_parameters(self.theta)


def residuals(candidate: Candidate, theta: np.ndarray, track: PoseTrack, noise: Noise) -> np.ndarray:
    """Displacement and rotation errors in units of their noise. [..., P] -> [..., S, 6]"""
    poses = candidate.poses(theta, track.tau)
    return se3.differences((track.quats, track.displacements), poses, noise.place, noise.turn)


def linearized(
    candidate: Candidate, theta: np.ndarray, track: PoseTrack, noise: Noise
) -> tuple[np.ndarray, np.ndarray]:
    """`residuals` [S, 6] and their derivatives by the parameters [P, S, 6]. theta [P]"""
    step = 1e-6
    nearby = theta + step * np.eye(len(theta) + 1, len(theta), -1)
    found = residuals(candidate, nearby, track, noise)
    return found[0], (found[1:] - found[0]) / step


def solve(
    candidate: Candidate,
    track: PoseTrack,
    noise: Noise,
    starts: Sequence[np.ndarray] | None = None,
    steps: int = 25,
    enough: float = _ENOUGH,
    hopeless: float = np.inf,
) -> FittedCandidate | None:
    """Fit a candidate to poses, robustly.

    Args:
        candidate: The family.
        track: The poses.
        noise: Noise of the poses, which sets the weights.
        starts: Initial guesses, or None for those of the candidate. [P] each
        steps: Maximum number of steps.
        enough: Gain of a step, in variances, below which the fit ends.
        hopeless: Loss above which the fit ends early if it improves slowly.

    Returns:
        The best of the solutions from all starts; None if the candidate cannot apply.
    """
    firsts = candidate.starts(track) if starts is None else list(starts)
    if not firsts:
        return None
    found = levenberg_marquardt.solve_all(
        lambda theta, _: residuals(candidate, theta, track, noise),
        np.array(firsts),
        weights=track.weights,
        precision=candidate.precision,
        softness=SOFTNESS,
        steps=steps,
        enough=enough,
        hopeless=hopeless,
        behind=HOPELESS_LOSS,
    )
    finite = np.isfinite(found.residuals).all((1, 2)) & np.isfinite(found.normal).all((1, 2))
    if not finite.any():
        return None
    return solution(candidate, found.row(int(np.argmin(np.where(finite, found.cost, np.inf)))), track)


def solution(candidate: Candidate, found: levenberg_marquardt.Solution, track: PoseTrack) -> FittedCandidate:
    """Fitted candidate of one start."""
    return FittedCandidate(candidate, found.x, found.normal, found.residuals, track.weights)

"""Joint fit of all kinds of breaks in all gaps, with exact derivatives.

All kinds share one set of parameters, of which each kind frees some. A body that rests before the break has dv = -v and
dw = -w. Notation as in `breaks`; B breaks, S poses, P parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import rotations, se3
from ..motion.pose_track import PoseTrack
from .candidates import Candidate, Noise

_NAMES = ("r", "e", "v", "w", "dv", "dw", "g", "a", "h", "c")
ROWS = {name: np.arange(3 * i, min(3 * i + 3, 28)) for i, name in enumerate(_NAMES)}
"""Indices of the shared parameters."""
_V, _W, _DV, _DW, _C = (slice(ROWS[name][0], ROWS[name][-1] + 1) for name in ("v", "w", "dv", "dw", "c"))
_TURNING = np.r_[ROWS["r"], ROWS["w"], ROWS["dw"], ROWS["c"]]  # parameters that change the rotation
COUNT = 28


def rows_of(candidate: Candidate) -> np.ndarray:
    """Shared parameters that a candidate frees, in its order. [P']"""
    return np.concatenate([ROWS[name] for name in ("r", "e", *candidate.blocks)])


@dataclass(frozen=True)
class Breaks:
    """Breaks to fit together.

    Attributes:
        low, high: Times of the poses before and after their gaps. [B, 1, 1]
        own: 1 for the parameters that each frees, else 0. [B, P]
        rests: 1 for breaks before which the body rests, else 0. [B, 1]
        slow: 1 for those at which its velocity is zero, else 0. [B, 1]
    """

    low: np.ndarray
    high: np.ndarray
    own: np.ndarray
    rests: np.ndarray
    slow: np.ndarray

    @staticmethod
    def of(kinds: Sequence[tuple[Candidate, bool, bool]], low: np.ndarray, high: np.ndarray) -> Breaks:
        """Breaks of each kind in each gap. Kinds: candidate, and `rests_before` and `starts_slowly` of its `Break`."""
        own = np.zeros((len(kinds), COUNT))
        for row, (candidate, _, _) in enumerate(kinds):
            own[row, rows_of(candidate)] = 1
        flags = np.array([[rests, slow] for _, rests, slow in kinds], float).repeat(len(low), axis=0)
        lows, highs = (np.tile(x, len(kinds))[:, None, None] for x in (low, high))
        return Breaks(lows, highs, own.repeat(len(low), axis=0), flags[:, :1], flags[:, 1:])

    def linearized(
        self, theta: np.ndarray, rows: np.ndarray, track: PoseTrack, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [L, S, 6] and their derivatives [L, P, S, 6] of some of the breaks [L]. theta [L, P]

        Source: a small rotation x that follows the modelled pose changes the rotation vector phi of the residual by
            -Jr^-1(phi) x, where Jr is the right Jacobian of the exponential.
        """
        count, poses = len(rows), len(track)
        rests, slow = self.rests[rows], self.slow[rows]
        full = theta.copy()
        full[:, _DV] -= rests * theta[:, _V]
        full[:, _DW] -= rests * theta[:, _W]
        r, e, v, w, dv, dw, g, a, h, x = (full[:, None, ROWS[name]] for name in _NAMES)
        low, width = self.low[rows], self.high[rows] - self.low[rows]
        share = 1 / (1 + np.exp(-np.clip(x, -4, 4)))
        c, c_slope = low + width * share, np.where(np.abs(x) < 4, width * share * (1 - share), 0.0)
        t = track.tau[:, None]
        b, f, before = np.minimum(t - c, 0), np.maximum(t, c), np.where(t < c, 1.0, 0.0)

        moves, slows = 1 - rests[..., None], slow[..., None]
        way = 0.5 * f**2 + moves * c * b - slows * c * f  # of a
        way_slope = f * before + moves * (b - c * before) - slows * (f + c * before)
        one = np.ones_like(b)
        ways = [one, t * one, b, 0.5 * t**2 * one, way, 0.5 * b**2]
        d = e + sum(part * factor for part, factor in zip((v, dv, g, a, h), ways[1:], strict=True))
        place_c = c_slope * (-dv * before + a * way_slope - h * b * before)

        to_r, (later, to_w), (earlier, to_b) = _exponential(r)[1], _exponential(w * f), _exponential((w + dw) * b)
        back = b[..., None] * to_b
        quats = rotations.multiply(rotations.rotvecs_to_quats((w + dw) * b), rotations.rotvecs_to_quats(w * f))
        quats = rotations.multiply(quats, rotations.rotvecs_to_quats(r))
        # The Jacobian of an exponential keeps its own axis.
        turn_c = c_slope * before * ((earlier @ w[..., None])[..., 0] - w - dw)
        turns = [earlier @ later @ to_r, f[..., None] * (earlier @ to_w) + back, back, turn_c[..., None]]

        values = se3.differences((track.quats, track.displacements), (quats, d), noise.place, noise.turn)
        inverse = _right_jacobian_inverse(noise.turn * values[..., 3:]) / -noise.turn
        slopes = np.zeros((count, COUNT, poses, 6))
        for name, factor in zip(("e", "v", "dv", "g", "a", "h"), ways, strict=True):
            for axis, row in enumerate(ROWS[name]):
                slopes[:, row, :, axis] = factor[..., 0] / -noise.place
        slopes[:, _C.start, :, :3] = place_c / -noise.place
        slopes[:, _TURNING, :, 3:] = (inverse @ np.concatenate(turns, -1)).transpose(0, 3, 1, 2)
        slopes[:, _V] -= rests[..., None, None] * slopes[:, _DV]
        slopes[:, _W] -= rests[..., None, None] * slopes[:, _DW]
        slopes *= self.own[rows][..., None, None]
        return values, slopes


def _exponential(rotvecs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrices of rotation vectors, and left Jacobians of the exponential. [..., 3] -> [..., 3, 3] each"""
    skew = rotations.skew(rotvecs)
    angle2 = (rotvecs * rotvecs).sum(-1)[..., None, None]
    square = rotvecs[..., :, None] * rotvecs[..., None, :] - angle2 * np.eye(3)
    a, b, c = (x(angle2) for x in (rotations.sine_ratio, rotations.versine_ratio, rotations.remainder_ratio))
    return np.eye(3) + a * skew + b * square, np.eye(3) + b * skew + c * square


def _right_jacobian_inverse(rotvecs: np.ndarray) -> np.ndarray:
    """Inverse right Jacobians of the exponential at angles of at most pi. [..., 3] -> [..., 3, 3]"""
    angle2 = (rotvecs * rotvecs).sum(-1)[..., None, None]
    square = rotvecs[..., :, None] * rotvecs[..., None, :] - angle2 * np.eye(3)
    half = 0.5 * np.sqrt(angle2)
    safe = np.where(half > 1e-3, half, 1.0)
    factor = np.where(half > 1e-3, (1 - safe / np.tan(safe)) / (4 * safe**2), 1 / 12)
    return np.eye(3) + 0.5 * rotations.skew(rotvecs) + factor * square

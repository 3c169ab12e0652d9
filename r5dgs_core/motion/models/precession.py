"""A spinning body whose axis precesses steadily about a pivot, such as a gyroscope or a top."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from .. import rotations
from ..pose_track import PoseTrack, Window
from . import first_guesses
from .base import Block, Curve, MotionKind, MotionModel, Rates

# Tried parts of the precession along the mean spin, as fractions of it. The change of the spin does not determine them.
_SHARES = (0.0, 0.5, -0.5, 1.0)


class Precession(MotionKind):
    """R_f = exp(p tau) exp((w - p) tau), d_f = u - R_f u, with the precession p and the spin w at t_max."""

    label = "Precession"
    tooltip = "Spins about an axis that turns steadily about a point, like a gyroscope"
    word = "precession"
    fields = ("angular_velocity", "precession", "center_offset")
    fits = {"precession": ("p", "s", "u")}
    blocks = {"p": Block(3, 30.0), "s": Block(3, 30.0)}

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        zero = 0 * span
        turn, own = rates.p * span, (rates.w - rates.p) * span
        axes = rotations.rotvecs_to_quats(turn)
        quats = rotations.multiply(axes, rotations.rotvecs_to_quats(own))
        spins = rates.p + rotations.rotate(axes, rates.w - rates.p + 0 * turn)
        arm = rotations.rotate(quats, rates.u + 0 * turn)
        return quats, rates.u - arm + zero, spins, -rotations.cross(spins, arm)

    def rates(self, parts: Mapping[str, np.ndarray], window: Window) -> Rates:
        return Rates(w=parts["p"] + parts["s"], p=parts["p"], u=parts["u"])

    def starts(self, blocks: Sequence[str], track: PoseTrack, window: Window) -> list[first_guesses.Guess]:
        """The spin obeys w' = p x w, which gives p by linear least squares up to a part along the mean spin."""
        if len(track) < 7:
            return []
        middles, spins, tau = track.middles, track.spins, track.tau[:, None]
        slopes = (spins[2:] - spins[:-2]) / (middles[2:] - middles[:-2])[:, None]
        x, y, z = spins[1:-1].T
        o = np.zeros_like(x)
        columns = -np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(-1, 3)
        across = np.linalg.lstsq(columns, slopes.reshape(-1), rcond=1e-3)[0]
        found = []
        for share in _SHARES:
            p = across + share * spins.mean(0)
            back = rotations.rotvecs_to_quats(-p * middles[:, None])
            s = rotations.rotate(back, spins - p).mean(0)
            turned = rotations.multiply(rotations.rotvecs_to_quats(p * tau), rotations.rotvecs_to_quats(s * tau))
            angles = rotations.angle_between(track.quats, turned)
            e, u = first_guesses.center(track, track.quats)
            guess = {"r": np.zeros(3), "e": e, "p": p, "s": s, "u": u}
            found.append((float((angles**2).sum()), share, guess))
        return [guess for _, _, guess in sorted(found, key=lambda entry: entry[:2])[:2]]

    def moves(self, model: MotionModel) -> bool:
        return self.spins(model)

    def spins(self, model: MotionModel) -> bool:
        return bool(model.angular_velocity.any() or model.precession.any())

    def center(self, model: MotionModel) -> np.ndarray:
        return model.center_offset

    def with_center(self, model: MotionModel, point: np.ndarray, old: np.ndarray) -> MotionModel:
        return replace(model, center_offset=point)

    def with_axis(self, model: MotionModel, turn: np.ndarray, through: np.ndarray | None) -> MotionModel:
        turned = super().with_axis(model, turn, through)
        return replace(turned, precession=rotations.rotate(turn, model.precession))


KIND = Precession()

"""A body that stays at its pose at t_max."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .. import rotations
from .base import Curve, MotionKind, MotionModel, Rates


class Static(MotionKind):
    """R_f = I, d_f = 0."""

    label = "Still"
    tooltip = "Does not move"
    word = "rests"
    fits = {"static": ()}
    plain_fits = ("static",)

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        shape = np.broadcast_shapes(rates.v.shape[:-1], span.shape[:-1])
        zero = np.zeros((*shape, 3))
        return rotations.identity(*shape), zero, zero, zero

    def stacked(self, models: Sequence[MotionModel]) -> None:
        return None

    def moves(self, model: MotionModel) -> bool:
        return False

    def spins(self, model: MotionModel) -> bool:
        return False


KIND = Static()

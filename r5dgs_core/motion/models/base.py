"""Base class of the kinds of motion past t_max, and the notation of motion models.

Notation: tau = t - t_max >= 0, p the group's pivot (its centre at t_max). A point of the bind state moves as
x(t) = p + R(tau) (x(t_max) - p) + d(tau). The fitted curve (R_f, d_f) starts from the identity at tau = 0. The observed
pose at t_max, which is the bind state, deviates from that curve by noise: `offset_rotvec` r and `offset_displacement` e
are the pose of the curve at t_max relative to the bind state. They are blended in with s = 1 - exp(-tau / fade_time):

    R(tau) = R_f(tau) exp(s r),    d(tau) = d_f(tau) + s e.

So R(0) = I and d(0) = 0 exactly, and the motion converges to the fitted curve R_f exp(r), d_f + e.

A motion may oscillate with angular frequency W: s1 = sin(W tau)/W and s2 = (1 - cos(W tau))/W^2 then replace the
factors tau and tau^2/2 of a steady motion. W = 0 gives the steady motion exactly. With damping c, s1 and s2 are the
solutions of s'' = -2 c s' - (W^2 + c^2) s + k, with k = 2 c for s1 and k = 1 for s2. At tau = 0, s1' = 1 and s2'' = 1;
s1, s1'', s2 and s2' are zero.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .. import rotations, se3
from ..pose_track import PoseTrack, Window
from . import first_guesses
from .motion_model import FIELDS, RATES, VECTORS, MotionModel

Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Quaternions [..., 4], displacements [..., 3], angular velocities in the world frame [..., 3], velocities [..., 3]."""
_MAX_EXPONENT = 600.0  # maximum exponent of a decay backwards in time
_AT_REST = [np.zeros(unit.size) for unit in FIELDS.values()]


class Block(NamedTuple):
    """Size of a block of free parameters, and the standard deviation of its weak prior about 0 (infinite: no prior)."""

    size: int
    prior: float = np.inf


# Priors are in radii and spans, and far wider than observed motions. They only constrain directions that the poses
# leave undetermined (a centre along its own axis, the centre of a body that does not rotate).
BLOCKS = {
    "r": Block(3),
    "e": Block(3),
    "v": Block(3),
    "a": Block(3, 100.0),
    "w": Block(3),
    "eps": Block(3, 100.0),
    "kappa": Block(1, 30.0),
    "u": Block(3, 10.0),
    "swing": Block(3, 10.0),
    "phase": Block(1, 10.0),
    "pace": Block(1, 5.0),
    "decay": Block(1, 2.0),
}
LOGARITHMS = (-6.0, 4.0)  # limits of the logarithms of decay rates per span


class Rates(namedtuple("Rates", [unit.symbol for unit in FIELDS.values()], defaults=_AT_REST)):
    """Rates of one or many motions, as arrays that broadcast against times [..., 1].

    The attributes are the symbols of the rates that `MotionModel` declares: v, a, w, eps and further vectors [..., 3],
    frequency, damping and further numbers [..., 1]. All are zero by default.
    """

    @classmethod
    def of(cls, models: Sequence[MotionModel]) -> Rates:
        """Rates of K models. [K, 3], [K, 1]"""
        return cls(*(np.array([np.atleast_1d(getattr(model, name)) for model in models]) for name in FIELDS))

    @classmethod
    def of_one(cls, model: MotionModel) -> Rates:
        """Rates of a model. [3], [1]"""
        return cls(*(np.atleast_1d(getattr(model, name)) for name in FIELDS))

    def time_factors(self, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors s1 of v and w and s2 of a and eps at times since t_max. [..., 1]"""
        return time_factors(self.frequency, span, self.damping)

    def time_factor_rates(self, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of `time_factors` with respect to time."""
        return time_factor_rates(self.frequency, span, self.damping)


class MotionKind:
    """A kind of motion. Each has a module of its name with its only instance, `KIND`.

    A kind with a closed form defines `motion`; one without defines `curve`, `stacked` and `fitted`. The remaining
    methods have defaults for motions without a rotation centre.

    Attributes:
        label: Name in Blender's menu.
        tooltip: Sentence under the name.
        word: Name in the output of ``r5dgs objects`` and ``r5dgs info``.
        fields: Fields of `MotionModel` that users edit.
        needs_inertia: True if `MotionModel.inertia` is needed.
        needs_knots: True if `MotionModel.knots` are needed.
        center_on_axis: True if any point of the axis may serve as the centre.
        fits: Name -> free blocks of the candidates with which `motion_fit` identifies this kind, beside the pose at
            t_max (r, e).
        blocks: Sizes and priors of blocks of `fits` that no other kind has; `BLOCKS` has the common ones.
        fits_by_default: False if a caller must choose these candidates by name.
        plain_fits: Names in `fits` of plain laws, which are tried first and describe parts of broken motions.
        frequency_blocks: Blocks of `fits` that determine a frequency.
        needs_support: True if a body that moves like this without spin on a vertical line would fall back.
        drawn_fits: Sets of free rates with which `fit_drawn_curve` tries this kind.
    """

    label: str
    tooltip: str
    word: str
    fields: tuple[str, ...] = ()
    needs_inertia = False
    needs_knots = False
    center_on_axis = False
    fits: Mapping[str, tuple[str, ...]] = {}
    blocks: Mapping[str, Block] = {}
    fits_by_default = True
    drawn_fits: tuple[tuple[str, ...], ...] = ()
    plain_fits: tuple[str, ...] = ()
    frequency_blocks: tuple[str, ...] = ("pace",)
    needs_support = False

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        """Poses and their exact derivatives without offsets, at times of either sign. [..., 1]

        Rates and times broadcast, and all results have the broadcast shape. At time 0 the pose is the identity.
        """
        raise NotImplementedError

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        """Poses without derivatives; override if this is cheaper than `motion`."""
        return self.motion(rates, span)[:2]

    def curve(self, model: MotionModel, tau: np.ndarray, most_steps: int | None) -> Curve:
        """`motion` of a model at times [...], in at most ``most_steps`` integration steps."""
        return self.motion(Rates.of_one(model), tau[..., None])

    def stacked(self, models: Sequence[MotionModel]) -> Callable[[float], se3.Pose] | None:
        """Function from a time > 0 to the poses of K models; None if they do not move. [K, 4], [K, 3]"""
        rates = Rates.of(models)
        return lambda tau: self.poses(rates, np.array([[tau]]))

    def fitted(
        self, rates: Rates, rotvec: np.ndarray, displacement: np.ndarray, tau: np.ndarray, inertia: np.ndarray | None
    ) -> se3.Pose:
        """Poses of a motion that starts from a pose other than the bind state.

        Args:
            rates: Rates [..., 1, 3], frequency [..., 1, 1].
            rotvec: Rotation at time 0. [..., 1, 3]
            displacement: Displacement at time 0. [..., 1, 3]
            tau: Times. [S]
            inertia: Inertia in the bind state, for kinds that need it. [3, 3]

        Returns:
            Quaternions [..., S, 4] and displacements [..., S, 3].
        """
        quats, d = self.poses(rates, tau[:, None])
        return rotations.multiply(quats, rotations.rotvecs_to_quats(rotvec)), d + displacement

    def rates(self, parts: Mapping[str, np.ndarray], window: Window) -> Rates:
        """Rates at t_max from the values of free blocks. [..., size of the block] each

        "v", "a", "w", "eps", "u" are those of `Rates`; "kappa" is the relative rate of a spin about a fixed axis:
        w(tau) = w_mid (1 + kappa (tau - middle)). "swing" q and "phase" f are an angle about a fixed axis,
        q exp(-c tau) sin(W tau + f), which stays determined if w or eps is zero; "pace" is the logit of W in the
        window, and "decay" the logarithm of c.
        """
        found = {name: parts[name] for name in ("v", "a", "w", "eps", "u") if name in parts}
        if "kappa" in parts:
            kappa, w_mid = parts["kappa"], parts["w"]
            found["eps"], found["w"] = kappa * w_mid, w_mid * (1 - kappa * window.middle)
        if "pace" in parts:
            found["frequency"] = window.frequency(parts["pace"])
        if "decay" in parts:
            found["damping"] = np.exp(np.clip(parts["decay"], *LOGARITHMS))
        if "swing" in parts:
            swing, phase, frequency, c = parts["swing"], parts["phase"], found["frequency"], found.get("damping", 0.0)
            cosine, sine = swing * np.cos(phase), swing * np.sin(phase)
            found["w"] = frequency * cosine - c * sine
            found["eps"] = (c**2 - frequency**2) * sine - 2 * c * frequency * cosine
        return Rates(**found)

    def observed(
        self, parts: Mapping[str, np.ndarray], tau: np.ndarray, window: Window, inertia: np.ndarray | None
    ) -> se3.Pose:
        """Poses of a candidate at times of the window and later. [..., 1, size] each, [S] -> [..., S, 4], [..., S, 3]

        Past t_max they are those of the rates of `rates`. Kinds with events in the window override it.
        """
        return self.fitted(self.rates(parts, window), parts["r"], parts["e"], tau, inertia)

    def starts(self, blocks: Sequence[str], track: PoseTrack, window: Window) -> list[first_guesses.Guess]:
        """First guesses of a candidate's blocks, most promising first; empty if it cannot apply."""
        if "pace" in blocks:
            return first_guesses.oscillation_guesses(blocks, track, window, time_factors)
        return [first_guesses.parabola(blocks, track)]

    def events(self, parts: Mapping[str, np.ndarray], window: Window) -> list[tuple[str, np.ndarray]]:
        """Kinds of the events in the window and their times, each [..., 1], from values of free blocks."""
        return []

    def resolved(self, parts: Mapping[str, np.ndarray], window: Window, count: int) -> bool:
        """True if ``count`` poses in the window resolve the motion with these values of its blocks."""
        return True

    def kinks(self, model: MotionModel, end: float) -> np.ndarray:
        """Times since t_max, in (0, end], at which the velocity or the acceleration jumps, increasing. [K]"""
        return np.zeros(0)

    def steps_needed(self, model: MotionModel, tau: np.ndarray) -> np.ndarray:
        """Number of integration steps for each pose. [S] -> [S]"""
        return np.ones(len(tau), np.int64)

    def moves(self, model: MotionModel) -> bool:
        """True if a vector rate that counts is not zero: a basic one or one of `fields`, except `center_offset`."""
        names = ({*RATES, *self.fields} & set(VECTORS)) - {"center_offset"}
        return any(getattr(model, name).any() for name in names)

    def spins(self, model: MotionModel) -> bool:
        """True if the curve has a rotation at any time."""
        return bool(model.angular_velocity.any() or model.angular_acceleration.any())

    def center(self, model: MotionModel) -> np.ndarray | None:
        """Point about which the motion rotates or oscillates at t_max, relative to the pivot, or None. [3]"""
        return None

    def with_center(self, model: MotionModel, point: np.ndarray, old: np.ndarray) -> MotionModel:
        """Move the centre, or the point ``old`` of the axis, to another point. [3]"""
        raise NotImplementedError

    def with_axis(self, model: MotionModel, turn: np.ndarray, through: np.ndarray | None) -> MotionModel:
        """Rotate the axis by a unit quaternion [4] about a point of it [3], or about `center` if None."""
        return replace(
            model,
            angular_velocity=rotations.rotate(turn, model.angular_velocity),
            angular_acceleration=rotations.rotate(turn, model.angular_acceleration),
        )


def time_factors(frequency: float | np.ndarray, span: np.ndarray, damping: float | np.ndarray = 0.0) -> se3.Pose:
    """Factors of the rates and of their derivatives in a motion that may oscillate.

    Args:
        frequency: W >= 0, rad per unit of time. [..., 1]
        span: Times tau since t_max, of either sign. [..., 1]
        damping: c >= 0, per unit of time; ignored if W = 0. [..., 1]

    Returns:
        s1 and s2 of the module's notation; exactly tau and tau^2/2 for W = 0.
    """
    if not np.any(damping):
        phase2 = (frequency * span) ** 2
        return span * rotations.sine_ratio(phase2), span**2 * rotations.versine_ratio(phase2)
    c = np.where(np.asarray(frequency) > 0, damping, 0.0)
    p, s, stiffness = _decaying(frequency, span, c)
    small = stiffness * span**2 < 1e-6
    safe = np.where(stiffness > 0, stiffness, 1.0)
    # Each factor is k (1 - p) + b s, with k and b from its initial values.
    once = np.where(small, span - stiffness * span**3 / 6, (2 * c * (1 - p) + (safe - 2 * c**2) * s) / safe)
    twice = np.where(small, 0.5 * span**2 - c * span**3 / 3, (1 - p - c * s) / safe)
    return once, twice


def time_factor_rates(frequency: float | np.ndarray, span: np.ndarray, damping: float | np.ndarray) -> se3.Pose:
    """Derivatives with respect to time of the factors of `time_factors`; same arguments."""
    if not np.any(damping):
        return np.cos(frequency * span), time_factors(frequency, span)[0]
    c = np.where(np.asarray(frequency) > 0, damping, 0.0)
    p, s, stiffness = _decaying(frequency, span, c)
    slope_s, slope_p = p - c * s, -c * p - np.asarray(frequency) ** 2 * s
    safe = np.where(stiffness > 0, stiffness, 1.0)
    once = np.where(stiffness > 0, (-2 * c * slope_p + (safe - 2 * c**2) * slope_s) / safe, 1.0)
    return once, s


def _decaying(
    frequency: float | np.ndarray, span: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """exp(-c tau) cos(W tau), exp(-c tau) sin(W tau) / W, and W^2 + c^2."""
    phase2 = (frequency * span) ** 2
    decay = np.exp(np.minimum(-c * span, _MAX_EXPONENT))
    return (
        decay * np.cos(frequency * span),
        decay * span * rotations.sine_ratio(phase2),
        np.asarray(frequency) ** 2 + c**2,
    )

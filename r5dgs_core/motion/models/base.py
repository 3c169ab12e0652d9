"""Motion models: rigid motion of a group past t_max as a small set of rates, and the base class of their kinds.

Notation: tau = t - t_max >= 0, p the group's pivot (its centre at t_max). A point of the bind state moves as
x(t) = p + R(tau) (x(t_max) - p) + d(tau). The fitted curve (R_f, d_f) starts from the identity at tau = 0. The observed
pose at t_max, which is the bind state, deviates from that curve by noise: `offset_rotvec` r and `offset_displacement` e
are the pose of the curve at t_max relative to the bind state. They are blended in with s = 1 - exp(-tau / fade_time):

    R(tau) = R_f(tau) exp(s r),    d(tau) = d_f(tau) + s e.

So R(0) = I and d(0) = 0 exactly, and the motion converges to the fitted curve R_f exp(r), d_f + e.

A motion may oscillate with angular frequency W: s1 = sin(W tau)/W and s2 = (1 - cos(W tau))/W^2 then replace the
factors tau and tau^2/2 of a steady motion. W = 0 gives the steady motion exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np

from .. import rotations, se3

Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Quaternions [..., 4], displacements [..., 3], angular velocities in the world frame [..., 3], velocities [..., 3]."""


class Unit(NamedTuple):
    """Unit of a rate: a vector that scales with the scene, or one of angles; per unit of time to a power."""

    is_length: bool
    per_time: int


RATES = {
    "velocity": Unit(True, 1),
    "acceleration": Unit(True, 2),
    "angular_velocity": Unit(False, 1),
    "angular_acceleration": Unit(False, 2),
    "center_offset": Unit(True, 0),
}
_VECTORS = {**RATES, "offset_rotvec": Unit(False, 0), "offset_displacement": Unit(True, 0)}
_RATE_NAMES = (*(f"{name}.{axis}" for name in _VECTORS for axis in "xyz"), "frequency")


def _zeros() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Rigid motion past t_max. Rates are at t_max, in the world frame; vectors are float64 [3].

    Attributes:
        kind: Name of the kind, a key of `KINDS`. A kind ignores the rates that are not its own.
        velocity: v, of the point `center_offset` off the pivot, world units per unit of time.
        acceleration: a, rate of v.
        angular_velocity: w, rad per unit of time.
        angular_acceleration: eps, rate of w.
        center_offset: u, position relative to the pivot at t_max of the body point that moves with v and a
            in kinds that spin about a centre. A hinge has v = a = 0 and u on its axis.
        offset_rotvec: r, rotation of the fitted curve at t_max relative to the bind state, rad.
        offset_displacement: e, its displacement.
        fade_time: Time constant with which the offsets are blended in, > 0.
        radius: Radius of the group, world units; tolerances are relative to it.
        frequency: W >= 0, rad per unit of time, of kinds that may oscillate; 0 for no oscillation.
        inertia: J in the world at tau = 0, up to a factor, of kinds that need it; None for others. [3, 3]
        covariance: Covariance of the fitted rates, or None. [P, P] in the order of `covariance_names`
        covariance_names: Names of its rows, such as "velocity.x"; "frequency" if it was fitted.
    """

    kind: str = "static"
    velocity: np.ndarray = field(default_factory=_zeros)
    acceleration: np.ndarray = field(default_factory=_zeros)
    angular_velocity: np.ndarray = field(default_factory=_zeros)
    angular_acceleration: np.ndarray = field(default_factory=_zeros)
    center_offset: np.ndarray = field(default_factory=_zeros)
    offset_rotvec: np.ndarray = field(default_factory=_zeros)
    offset_displacement: np.ndarray = field(default_factory=_zeros)
    fade_time: float = 0.1
    radius: float = 1.0
    frequency: float = 0.0
    inertia: np.ndarray | None = None
    covariance: np.ndarray | None = None
    covariance_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        for name in _VECTORS:
            value = getattr(self, name)
            try:
                vector = np.array(value, np.float64)
            except (TypeError, ValueError):
                vector = np.zeros(0)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise ValueError(f"{name}: expected three finite numbers, got {value!r}")
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)
        for name in ("fade_time", "radius"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a positive number, got {value}")
            object.__setattr__(self, name, value)
        frequency = float(self.frequency)
        if not (math.isfinite(frequency) and frequency >= 0):
            raise ValueError(f"frequency: expected a number >= 0, got {frequency}")
        object.__setattr__(self, "frequency", frequency)
        if (self.inertia is not None) != KINDS[self.kind].needs_inertia:
            expected = "a (3, 3)" if KINDS[self.kind].needs_inertia else "None"
            raise ValueError(f"inertia: expected {expected} for the kind {self.kind!r}, got {self.inertia!r}")
        if self.inertia is not None:
            inertia = np.array(self.inertia, np.float64)
            sound = inertia.shape == (3, 3) and np.isfinite(inertia).all()
            if not (sound and np.allclose(inertia, inertia.T) and np.linalg.eigvalsh(inertia)[0] > 0):
                raise ValueError(f"inertia: expected a symmetric (3, 3) with positive moments, got {self.inertia!r}")
            inertia.flags.writeable = False
            object.__setattr__(self, "inertia", inertia)
        object.__setattr__(self, "covariance_names", tuple(self.covariance_names))
        foreign = [name for name in self.covariance_names if name not in _RATE_NAMES]
        if foreign:
            raise ValueError(f"covariance_names: expected names such as 'velocity.x', got {foreign[0]!r:.60}")
        if self.covariance is not None:
            covariance = np.array(self.covariance, np.float64)
            size = len(self.covariance_names)
            if covariance.shape != (size, size) or not np.isfinite(covariance).all():
                raise ValueError(f"covariance: expected finite ({size}, {size}), got {covariance.shape}")
            object.__setattr__(self, "covariance", covariance)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MotionModel) and self.to_dict() == other.to_dict()

    __hash__ = None  # type: ignore[assignment]

    def to_dict(self) -> dict[str, Any]:
        """Return the model as JSON types; `from_dict` restores it exactly."""
        result: dict[str, Any] = {"kind": self.kind}
        for name in _VECTORS:
            result[name] = getattr(self, name).tolist()
        result.update(fade_time=self.fade_time, radius=self.radius)
        if self.frequency > 0:
            result["frequency"] = self.frequency
        if self.inertia is not None:
            result["inertia"] = self.inertia.tolist()
        if self.covariance is not None:
            result.update(covariance=self.covariance.tolist(), covariance_names=list(self.covariance_names))
        return result

    @staticmethod
    def from_dict(data: dict[str, Any]) -> MotionModel:
        """Inverse of `to_dict`. Raises ValueError that names the unknown or malformed key."""
        if not isinstance(data, dict) or "kind" not in data:
            raise ValueError(f"expected an object with the key 'kind', got {data!r}")
        known = {f.name for f in fields(MotionModel)}
        unknown = sorted(set(data) - known)
        if unknown:
            raise ValueError(f"{unknown[0]}: unknown key of a motion model")
        try:
            return MotionModel(**data)
        except TypeError as error:
            raise ValueError(f"malformed motion model: {error}") from error

    @property
    def is_static(self) -> bool:
        """True if `evaluate` returns the identity at every time."""
        offset = self.offset_rotvec.any() or self.offset_displacement.any()
        return not (offset or KINDS[self.kind].moves(self))

    @property
    def turns(self) -> bool:
        """True if `evaluate` returns a rotation at any time."""
        return bool(KINDS[self.kind].spins(self) or self.offset_rotvec.any())

    def transformed(self, turn: np.ndarray, scale: float) -> MotionModel:
        """Motion of the group after a similarity of the world, with its covariance.

        Args:
            turn: Rotation, which transforms rates of angles. [3, 3]
            scale: Scale of lengths, negative for a mirror.
        """
        maps = {name: scale * turn if unit.is_length else turn for name, unit in _VECTORS.items()}
        values = {name: linear @ getattr(self, name) for name, linear in maps.items()}
        if self.inertia is not None:
            inertia = turn @ self.inertia @ turn.T
            values["inertia"] = 0.5 * (inertia + inertia.T)
        if self.covariance is not None:
            change = _change(self.covariance_names, maps)
            values["covariance"] = change @ self.covariance @ change.T
        return replace(self, radius=abs(scale) * self.radius, **values)


def _change(names: tuple[str, ...], maps: dict[str, np.ndarray]) -> np.ndarray:
    """Change of basis for rates given by name, such as "velocity.x". [P, P]"""
    change = np.eye(len(names))
    parts = [name.partition(".") for name in names]
    for i, (field_name, _, axis) in enumerate(parts):
        for j, (other, _, other_axis) in enumerate(parts):
            if axis and field_name == other and field_name in maps:
                change[i, j] = maps[field_name]["xyz".index(axis), "xyz".index(other_axis)]
    return change


class Rates(NamedTuple):
    """Rates of one or many motions, as arrays that broadcast against times [..., 1].

    Attributes:
        v: Velocity. [..., 3]
        a: Acceleration. [..., 3]
        w: Angular velocity. [..., 3]
        eps: Angular acceleration. [..., 3]
        u: Centre of rotation relative to the pivot. [..., 3]
        frequency: [..., 1]
    """

    v: np.ndarray
    a: np.ndarray
    w: np.ndarray
    eps: np.ndarray
    u: np.ndarray
    frequency: np.ndarray

    @classmethod
    def of(cls, models: Sequence[MotionModel]) -> Rates:
        """Rates of K models. [K, 3], [K, 1]"""
        v, a, w, eps, u = (np.array([getattr(model, name) for model in models]) for name in RATES)
        return cls(v, a, w, eps, u, np.array([[model.frequency] for model in models]))

    def clocks(self, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors s1 of v and w and s2 of a and eps at times since t_max. [..., 1]"""
        return clocks(self.frequency, span)


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
        center_on_axis: True if each point of the axis serves as the centre.
        fits: Name -> free blocks of the candidates with which `motion_fit` identifies this kind, see `Candidate`.
        fits_by_default: False if a caller must choose these candidates by name.
        may_tumble: True if a freely tumbling body may be fitted by this kind, so that the free top is tried.
        drawn_fits: Sets of free rates with which `fit_drawn_curve` tries this kind.
    """

    label: str
    tooltip: str
    word: str
    fields: tuple[str, ...] = ()
    needs_inertia = False
    center_on_axis = False
    fits: Mapping[str, tuple[str, ...]] = {}
    fits_by_default = True
    may_tumble = False
    drawn_fits: tuple[tuple[str, ...], ...] = ()

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        """Poses and their exact derivatives without offsets, at times of either sign. [..., 1]

        The rates broadcast against the times. At time 0 the pose is the identity.
        """
        raise NotImplementedError

    def poses(self, rates: Rates, span: np.ndarray) -> se3.Pose:
        """Poses without derivatives; override if this is cheaper than `motion`."""
        return self.motion(rates, span)[:2]

    def curve(self, model: MotionModel, tau: np.ndarray, most_steps: int | None) -> Curve:
        """`motion` of a model at times [...], in at most ``most_steps`` integration steps."""
        v, a, w, eps, u = (getattr(model, name) for name in RATES)
        return self.motion(Rates(v, a, w, eps, u, np.array(model.frequency)), tau[..., None])

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

    def steps_needed(self, model: MotionModel, tau: np.ndarray) -> np.ndarray:
        """Number of integration steps for each pose. [S] -> [S]"""
        return np.ones(len(tau), np.int64)

    def moves(self, model: MotionModel) -> bool:
        """True if the curve is not the identity at all times."""
        return any(getattr(model, name).any() for name in RATES if name != "center_offset")

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


KINDS: dict[str, MotionKind] = {}
"""Kinds by name, in the order of Blender's menu; the package fills it."""


def clocks(frequency: float | np.ndarray, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors of the rates and of their derivatives in a motion that may oscillate.

    Args:
        frequency: W >= 0, rad per unit of time. [..., 1]
        span: Times tau since t_max, of either sign. [..., 1]

    Returns:
        s1 = sin(W tau)/W and s2 = (1 - cos(W tau))/W^2; exactly tau and tau^2/2 for W = 0.
    """
    phase2 = (frequency * span) ** 2
    return span * rotations.sine_ratio(phase2), span**2 * rotations.versine_ratio(phase2)

"""The `MotionModel` dataclass: rigid motion of a group past t_max as a small set of rates. `base` has the notation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np

from .. import knots as trajectories
from .registry import KINDS


class Unit(NamedTuple):
    """Unit of a rate: a length or an angle, per unit of time to a power.

    Attributes:
        symbol: Name of the rate in `base.Rates`.
        size: 3 for a vector, 1 for a number >= 0.
        is_length: True if the rate scales with the scene.
        per_time: Power of the inverse unit of time.
    """

    symbol: str
    size: int
    is_length: bool
    per_time: int


_BASIC_KINDS = ("static", "translation", "ballistic_spin", "constant_twist", "world_twist", "free_top")
_NEWER = "if a later release wrote the motion, update R5DGS"


def _vector(symbol: str, is_length: bool, per_time: int) -> Any:
    """Field of a vector rate; the arguments are those of `Unit`."""
    return field(default_factory=lambda: np.zeros(3), metadata={"unit": Unit(symbol, 3, is_length, per_time)})


def _number(symbol: str, per_time: int) -> Any:
    """Field of a rate that is a number >= 0; it must not be a length."""
    return field(default=0.0, metadata={"unit": Unit(symbol, 1, False, per_time)})


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
        damping: c >= 0, per unit of time: decay rate of an oscillation, or of the velocity under drag.
        precession: p, angular velocity with which the spin axis of the kind "precession" turns.
        stop_time: T >= 0, time past t_max at which a body of the kind "friction" rests; 0 if it never does.
        bounce_time: Time past t_max of the next impact of the kind "bounce", >= 0.
        restitution: Speed after an impact / speed before it, in [0, 1].
        second_velocity: As `velocity`, of the second oscillation of the kind "two_oscillations"; likewise the others.
        inertia: J in the world at tau = 0, up to a factor, of kinds that need it; None for others. [3, 3]
        knots: Knots of the kind "trajectory" (`knots.pack`), None for others. [K, 20]
        covariance: Covariance of the fitted rates, or None. [P, P] in the order of `covariance_names`
        covariance_names: Names of its rows, such as "velocity.x" or "frequency".
    """

    kind: str = "static"
    velocity: np.ndarray = _vector("v", True, 1)
    acceleration: np.ndarray = _vector("a", True, 2)
    angular_velocity: np.ndarray = _vector("w", False, 1)
    angular_acceleration: np.ndarray = _vector("eps", False, 2)
    center_offset: np.ndarray = _vector("u", True, 0)
    offset_rotvec: np.ndarray = _vector("r", False, 0)
    offset_displacement: np.ndarray = _vector("e", True, 0)
    fade_time: float = 0.1
    radius: float = 1.0
    frequency: float = _number("frequency", 1)
    second_frequency: float = _number("frequency2", 1)
    damping: float = _number("damping", 1)
    precession: np.ndarray = _vector("p", False, 1)
    stop_time: float = _number("stop_time", -1)
    bounce_time: float = _number("bounce_time", -1)
    restitution: float = _number("restitution", 0)
    second_velocity: np.ndarray = _vector("v2", True, 1)
    second_acceleration: np.ndarray = _vector("a2", True, 2)
    second_angular_velocity: np.ndarray = _vector("w2", False, 1)
    second_angular_acceleration: np.ndarray = _vector("eps2", False, 2)
    inertia: np.ndarray | None = None
    knots: np.ndarray | None = None
    covariance: np.ndarray | None = None
    covariance_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {self.kind!r}; {_NEWER}")
        for name in VECTORS:
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
        for name in SCALARS:
            value, most = float(getattr(self, name)), 1.0 if name == "restitution" else math.inf
            if not (math.isfinite(value) and 0 <= value <= most):
                raise ValueError(f"{name}: expected a number {'from 0 to 1' if most == 1 else '>= 0'}, got {value}")
            object.__setattr__(self, name, value)
        self._check_inertia()
        self._check_knots()
        self._check_covariance()

    def _check_inertia(self) -> None:
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

    def _check_knots(self) -> None:
        if (self.knots is not None) != KINDS[self.kind].needs_knots:
            expected = "those of a trajectory" if KINDS[self.kind].needs_knots else "None"
            raise ValueError(f"knots: expected {expected} for the kind {self.kind!r}")
        if self.knots is not None:
            object.__setattr__(self, "knots", trajectories.checked(self.knots))

    def _check_covariance(self) -> None:
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
        for name in VECTORS:
            value = getattr(self, name)
            if name not in EXTRA_RATES or value.any():
                result[name] = value.tolist()
        result.update(fade_time=self.fade_time, radius=self.radius)
        result.update({name: value for name in SCALARS if (value := getattr(self, name)) > 0})
        if self.inertia is not None:
            result["inertia"] = self.inertia.tolist()
        if self.knots is not None:
            result["knots"] = self.knots.tolist()
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
            raise ValueError(f"{unknown[0]}: unknown key of a motion model; {_NEWER}")
        try:
            return MotionModel(**data)
        except TypeError as error:
            raise ValueError(f"malformed motion model: {error}") from error

    @property
    def is_static(self) -> bool:
        """True if there is no offset and the kind does not move (`MotionKind.moves`): all poses are the identity."""
        offset = self.offset_rotvec.any() or self.offset_displacement.any()
        return not (offset or KINDS[self.kind].moves(self))

    @property
    def is_basic(self) -> bool:
        """True if R5DGS 0.1.0 supports the kind and all of its rates."""
        added = (*EXTRA_RATES, *(name for name in SCALARS if name != "frequency"))
        return self.kind in _BASIC_KINDS and not any(np.any(getattr(self, name)) for name in added)

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
        maps = {name: scale * turn if unit.is_length else turn for name, unit in VECTORS.items()}
        values = {name: linear @ getattr(self, name) for name, linear in maps.items()}
        if self.inertia is not None:
            inertia = turn @ self.inertia @ turn.T
            values["inertia"] = 0.5 * (inertia + inertia.T)
        if self.knots is not None:
            values["knots"] = trajectories.transformed(self.knots, turn, scale)
        if self.covariance is not None:
            change = _change(self.covariance_names, maps)
            values["covariance"] = change @ self.covariance @ change.T
        return replace(self, radius=abs(scale) * self.radius, **values)


_UNITS: dict[str, Unit] = {f.name: f.metadata["unit"] for f in fields(MotionModel) if "unit" in f.metadata}
_BASIC_RATES = ("velocity", "acceleration", "angular_velocity", "angular_acceleration", "center_offset")
VECTORS = {name: unit for name, unit in _UNITS.items() if unit.size == 3}
"""Vectors of a model, the offsets included."""
RATES = {name: VECTORS[name] for name in _BASIC_RATES}
"""Vectors that are always stored."""
EXTRA_RATES = {name: unit for name, unit in VECTORS.items() if name not in RATES and not name.startswith("offset_")}
"""Vectors of single kinds; stored only if they are not zero."""
SCALARS = {name: unit for name, unit in _UNITS.items() if unit.size == 1}
"""Numbers >= 0; stored only if they are not zero."""
FIELDS = {**RATES, **EXTRA_RATES, **SCALARS}
"""Rates that users edit, in the order of `base.Rates`."""
_RATE_NAMES = (*(f"{name}.{axis}" for name in VECTORS for axis in "xyz"), *SCALARS)


def _change(names: tuple[str, ...], maps: dict[str, np.ndarray]) -> np.ndarray:
    """Change of basis for rates given by name, such as "velocity.x". [P, P]"""
    change = np.eye(len(names))
    parts = [name.partition(".") for name in names]
    for i, (field_name, _, axis) in enumerate(parts):
        for j, (other, _, other_axis) in enumerate(parts):
            if axis and field_name == other and field_name in maps:
                change[i, j] = maps[field_name]["xyz".index(axis), "xyz".index(other_axis)]
    return change

"""Motion models: rigid motion of a group past t_max as a small set of rates, in closed form if one exists.

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

import functools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from . import free_top, rotations, se3, twist_propagation

log = logging.getLogger(__name__)

KINDS = ("static", "translation", "ballistic_spin", "constant_twist", "world_twist", "free_top")
_VECTORS = (
    "velocity",
    "acceleration",
    "angular_velocity",
    "angular_acceleration",
    "center_offset",
    "offset_rotvec",
    "offset_displacement",
)
_RATE_NAMES = (*(f"{name}.{axis}" for name in _VECTORS for axis in "xyz"), "frequency")
_STEP_TOLERANCE = 1e-9  # allowed Magnus-4 error of `world_twist`, in radii
_MOST_STEPS = 1 << 20  # Magnus steps to one time


def _zeros() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Rigid motion past t_max. Rates are at t_max, in the world frame; vectors are float64 [3].

    Attributes:
        kind: "static" (stays), "translation" (d_f = v s1 + a s2), "ballistic_spin" (centroid form: d_f = v s1 + a
            s2 + u - R_f u, R_f = exp(w s1 + eps s2)), "constant_twist" (a screw: R_f = exp(w tau),
            d_f = V(w tau) v tau), "world_twist" (v(x) = v + w x (x - p) with v and w linear in time, x in the world;
            Magnus-4 steps) or "free_top" (d_f = v tau + a tau^2 / 2, R_f of a body that starts with spin w and tumbles
            without torque, `free_top`).
        velocity: v, of the point `center_offset` off the pivot, world units per unit of time.
        acceleration: a, rate of v.
        angular_velocity: w, rad per unit of time.
        angular_acceleration: eps, rate of w.
        center_offset: u, position relative to the pivot at t_max of the body point that moves with v and a
            ("ballistic_spin" only). A hinge has v = a = 0 and u on its axis.
        offset_rotvec: r, rotation of the fitted curve at t_max relative to the bind state, rad.
        offset_displacement: e, its displacement.
        fade_time: Time constant with which the offsets are blended in, > 0.
        radius: Radius of the group, world units; tolerances are relative to it.
        frequency: W >= 0, rad per unit of time, of "translation" (a spring) and "ballistic_spin" (a pendulum, with
            v = a = 0 and u on its axis); 0 for no oscillation.
        inertia: J of a "free_top" in the world at tau = 0, up to a factor; None for other kinds. [3, 3]
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
        if (self.inertia is not None) != (self.kind == "free_top"):
            raise ValueError(f"inertia: expected for the kind 'free_top' alone, got {self.inertia!r} for {self.kind!r}")
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
        moving = [*(getattr(self, n) for n in _VECTORS if n != "center_offset")] if self.kind != "static" else []
        return not any(v.any() for v in (*moving, self.offset_rotvec, self.offset_displacement))

    @property
    def turns(self) -> bool:
        """True if `evaluate` returns a rotation at any time."""
        spins = self.kind not in ("static", "translation") and (
            self.angular_velocity.any() or (self.angular_acceleration.any() and self.kind != "free_top")
        )
        return bool(spins or self.offset_rotvec.any())


STATIC = MotionModel()


def evaluate(model: MotionModel, tau: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the group relative to its bind state.

    Args:
        model: The motion.
        tau: Time since t_max, >= 0, any shape. [...]

    Returns:
        Unit quaternions wxyz [..., 4] and displacements of the pivot, world [..., 3], float64. tau = 0 gives exactly
        (1, 0, 0, 0) and 0. If a pose is not finite, the body stays at its pose at t_max, with a warning.
    """
    quats, displacements, _, _ = evaluate_with_rates(model, tau)
    return quats, displacements


def evaluate_all(models: Sequence[MotionModel], tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate G models at one time, vectorised over the models. For many times, keep a `Stack`.

    Returns:
        Unit quaternions wxyz [G, 4] and displacements [G, 3].
    """
    return Stack(models).poses(tau)


class Stack:
    """Several motions, evaluated together at any time. Time-independent quantities are precomputed."""

    def __init__(self, models: Sequence[MotionModel]):
        self._count = len(models)
        self._kinds = []
        for kind in sorted({model.kind for model in models} - {"static"}):
            rows = np.array([g for g, model in enumerate(models) if model.kind == kind])
            chosen = [models[g] for g in rows]
            rates = tuple(np.array([getattr(model, name) for model in chosen]) for name in _VECTORS[:5])
            self._kinds.append((kind, rows, rates, _prepared(kind, chosen, rates)))
        self._faded = np.array(
            [g for g, m in enumerate(models) if m.offset_rotvec.any() or m.offset_displacement.any()]
        )
        fading = [models[g] for g in self._faded]
        self._fade_times = np.array([[model.fade_time] for model in fading])
        self._rotvecs = np.array([model.offset_rotvec for model in fading])
        self._displacements = np.array([model.offset_displacement for model in fading])

    def poses(self, tau: float) -> tuple[np.ndarray, np.ndarray]:
        """Unit quaternions wxyz [G, 4] and displacements [G, 3] at a time since t_max, as from `evaluate`."""
        if tau < 0:
            raise ValueError(f"tau: expected a time since t_max >= 0, got {tau}")
        quats, displacements = rotations.identity(self._count), np.zeros((self._count, 3))
        if tau == 0:
            return quats, displacements
        span = np.array([[float(tau)]])
        with np.errstate(over="ignore", invalid="ignore"):
            for kind, rows, (v, a, w, eps, u), prepared in self._kinds:
                if kind == "translation":
                    once, twice = clocks(prepared, span)
                    displacements[rows] = v * once + a * twice
                elif kind == "ballistic_spin":
                    quats[rows], displacements[rows] = spin_poses(v, a, w, eps, u, prepared, span)
                elif kind == "constant_twist":
                    quats[rows], displacements[rows] = twist_poses(v, w, span)
                elif kind == "world_twist":
                    quats[rows], displacements[rows] = prepared.rows_of(float(tau))
                else:
                    tops, frequencies = prepared
                    once, twice = clocks(frequencies, span)
                    quats[rows], displacements[rows] = tops.turns(float(tau)), v * once + a * twice
            if len(self._faded):
                s = -np.expm1(-tau / self._fade_times)
                faded = rotations.rotvecs_to_quats(s * self._rotvecs)
                quats[self._faded] = rotations.multiply(quats[self._faded], faded)
                displacements[self._faded] += s * self._displacements
        held = _held(quats, displacements)
        return held[0], held[1]


def _prepared(kind: str, models: Sequence[MotionModel], rates: tuple[np.ndarray, ...]) -> Any:
    """Time-independent data for evaluating the motions of one kind, in addition to their rates."""
    frequencies = np.array([[model.frequency] for model in models])
    if kind == "world_twist":
        v, a, w, eps, _ = rates
        radii = np.array([model.radius for model in models])
        return twist_propagation.Propagator(
            np.concatenate([v, w, a, eps], -1), _STEP_TOLERANCE * radii, radii, _MOST_STEPS
        )
    if kind == "free_top":
        return free_top.Tops(np.array([model.inertia for model in models]), rates[2]), frequencies
    return frequencies


def _held(*parts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Replace poses and rates that are not finite by those of a body at rest."""
    sound = np.all([np.isfinite(part).all(-1) for part in parts], axis=0)
    if sound.all():
        return parts
    _warn_of_wild_motion()
    still = (rotations.identity(), *([np.zeros(3)] * (len(parts) - 1)))
    return tuple(np.where(np.expand_dims(sound, -1), part, rest) for part, rest in zip(parts, still, strict=True))


@functools.cache
def _warn_of_wild_motion() -> None:
    log.warning(
        "a motion model leaves the range of numbers; its body stays where it is at t_max. Remedy: smaller rates"
    )


def evaluate_with_rates(
    model: MotionModel, tau: float | np.ndarray, most_steps: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pose as from `evaluate`, with its exact time derivative.

    Args:
        model: The motion.
        tau: Time since t_max, >= 0, any shape. [...]
        most_steps: Largest number of integration steps for all times together, or None for no limit. If more are
            needed, times share steps; if even that is not enough, poses are rigid but inaccurate.

    Returns:
        Quaternions [..., 4], displacements [..., 3], angular velocities in the world frame, rad per unit [..., 3], and
        velocities of the pivot [..., 3].
    """
    tau = np.asarray(tau, np.float64)
    if (tau < 0).any():
        raise ValueError(f"tau: expected times since t_max >= 0, got {tau.min()}")
    with np.errstate(over="ignore", invalid="ignore"):
        quats, displacements, spins, velocities = curve(model, tau, most_steps)
        s = -np.expm1(-tau / model.fade_time)[..., None]
        rate = (1 - s) / model.fade_time
        blended = rotations.multiply(quats, rotations.rotvecs_to_quats(s * model.offset_rotvec))
        held = _held(
            blended,
            displacements + s * model.offset_displacement,
            spins + rate * rotations.rotate(quats, np.broadcast_to(model.offset_rotvec, spins.shape)),
            velocities + rate * model.offset_displacement,
        )
    return held[0], held[1], held[2], held[3]


def curve(
    model: MotionModel, tau: float | np.ndarray, most_steps: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The fitted curve (R_f, d_f) without offsets, the identity at tau = 0, with its exact derivative.

    Args:
        model: The motion.
        tau: Time since t_max, of either sign, any shape. [...]
        most_steps: As in `evaluate_with_rates`, for times >= 0.

    Returns:
        As `evaluate_with_rates`.
    """
    tau = np.asarray(tau, np.float64)
    span = tau[..., None]
    zero = np.zeros((*tau.shape, 3))
    v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
    if model.kind == "static":
        return rotations.identity(*tau.shape), zero, zero, zero
    once, twice = clocks(model.frequency, span)
    slope = np.cos(model.frequency * span)  # derivative of s1; that of s2 is s1
    if model.kind == "translation":
        return rotations.identity(*tau.shape), v * once + a * twice, zero, v * slope + a * once
    if model.kind == "ballistic_spin":
        u = model.center_offset
        quats, d = spin_poses(v, a, w, eps, u, model.frequency, span)
        # R = exp(phi) has angular velocity V(phi) phi'.
        spins = se3.v_matrix_times(w * once + eps * twice, w * slope + eps * once)
        return quats, d, spins, v * slope + a * once - rotations.cross(spins, rotations.rotate(quats, u + zero))
    if model.kind == "constant_twist":
        quats, d = twist_poses(v, w, span)
        return quats, d, w + zero, rotations.rotate(quats, v + zero)
    if model.kind == "free_top":
        assert model.inertia is not None
        quats, spins = free_top.turns(model.inertia, w, tau.reshape(-1))
        quats, spins = quats.reshape(*tau.shape, 4), spins.reshape(*tau.shape, 3)
        return quats, v * once + a * twice, spins, v * slope + a * once
    quats, d = _world_twist(model, tau, most_steps)
    spins = w + eps * span
    return quats, d, spins, v + a * span + rotations.cross(spins, d)


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


def spin_poses(
    v: np.ndarray,
    a: np.ndarray,
    w: np.ndarray,
    eps: np.ndarray,
    center: np.ndarray,
    frequency: float | np.ndarray,
    span: np.ndarray,
) -> se3.Pose:
    """Poses of "ballistic_spin". All arguments broadcast: rates [..., 3], frequency and times span [..., 1]."""
    once, twice = clocks(frequency, span)
    quats = rotations.rotvecs_to_quats(w * once + eps * twice)
    arm = rotations.rotate(quats, center + 0 * quats[..., 1:])
    return quats, v * once + a * twice + (center - arm)


def twist_poses(v: np.ndarray, w: np.ndarray, span: np.ndarray) -> se3.Pose:
    """Poses of "constant_twist". All arguments broadcast: v, w [..., 3], times span [..., 1]."""
    turn = w * span
    return rotations.rotvecs_to_quats(turn), se3.v_matrix_times(turn, v + 0 * turn) * span


def _world_twist(model: MotionModel, tau: np.ndarray, most_steps: int | None) -> se3.Pose:
    """Magnus-4 poses, each time with its own number of steps rounded up to a power of two.

    Poses are NaN at times that no number of steps reaches within the tolerance.
    """
    v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
    flat = tau.reshape(-1)
    needed = steps_needed(model, flat)
    steps = np.minimum(1 << np.ceil(np.log2(needed)).astype(np.int64), _MOST_STEPS)
    quats, displacements = rotations.identity(len(flat)), np.zeros((len(flat), 3))
    hopeless = needed >= se3.MOST_STEPS
    quats[hopeless] = np.nan
    if most_steps is not None and steps[~hopeless].sum() > most_steps:
        quats[~hopeless], displacements[~hopeless] = _shared_steps(
            model, flat[~hopeless], needed[~hopeless], most_steps
        )
        return quats.reshape(*tau.shape, 4), displacements.reshape(*tau.shape, 3)
    for n in np.unique(steps[~hopeless]):
        rows = np.flatnonzero((steps == n) & ~hopeless)
        for block in np.array_split(rows, max(1, len(rows) * int(n) >> 18)):
            quats[block], displacements[block] = se3.integrate(w, v, eps, a, flat[block], int(n))
    return quats.reshape(*tau.shape, 4), displacements.reshape(*tau.shape, 3)


def _shared_steps(model: MotionModel, taus: np.ndarray, needed: np.ndarray, most: int) -> se3.Pose:
    """Magnus-4 poses at times >= 0, each integrated from the previous one: [S] -> [S, 4], [S, 3].

    All intervals between times take the same number of steps: enough for the step length that the hardest time needs,
    or as many as ``most`` allows.
    """
    v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
    times, rows = np.unique(taus, return_inverse=True)
    starts = np.concatenate([[0.0], times[:-1]])
    gaps = times - starts
    shortest = float((taus / needed)[needed.argmax()])
    steps = int(min(max(1.0, np.ceil(gaps.max() / shortest)), max(1, most // len(times))))
    w_start, v_start = w + starts[:, None] * eps, v + starts[:, None] * a
    parts = [
        se3.integrate(w_start[block], v_start[block], eps, a, gaps[block], steps)
        for block in np.array_split(np.arange(len(times)), 1 + (len(times) * steps >> 18))
    ]
    quats, displacements = se3.scan(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return rotations.normalize(quats)[rows], displacements[rows]


def steps_needed(model: MotionModel, tau: np.ndarray) -> np.ndarray:
    """Number of integration steps for each pose; 1 for kinds with a closed form. [S] -> [S]"""
    if model.kind != "world_twist":
        return np.ones(len(tau), np.int64)
    v, a, w, eps = model.velocity, model.acceleration, model.angular_velocity, model.angular_acceleration
    return se3.steps_needed(w, v, eps, a, tau, model.radius, _STEP_TOLERANCE * model.radius)

"""Stability cases on rotations: series at small angles, half turns, signs, angles, precision."""

from __future__ import annotations

import functools
import math
from decimal import Decimal

import numpy as np

from ..motion import rotations
from .cases import ROUNDING, Case, angle, body, different, largest, ratios

_SMALL = (0.0, 1e-300, 1e-160, 1e-30, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2, 0.3, 0.7, 0.99, 1.01, 1.4, 2.0)
_RATIOS = (rotations.sine_ratio, rotations.versine_ratio, rotations.remainder_ratio)


def _ratio(index: int, dtype: type) -> float:
    """Largest relative error of a coefficient of the exponential, at squared angles rounded to the dtype."""
    squares = (np.array(_SMALL) ** 2).astype(dtype)
    values = _RATIOS[index](squares)
    exact = [ratios(float(x))[index] for x in squares]
    return max(float(abs(Decimal(float(v)) / e - 1)) for v, e in zip(values, exact, strict=True))


def _gradients() -> float:
    """Largest error of the gradients of the exponential at and near the identity."""
    import torch

    worst = 0.0
    for size in (0.0, 1e-300, 1e-160, 1e-12, 1e-4):
        rotvec = torch.tensor([size, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
        jacobian = torch.autograd.functional.jacobian(rotations.rotvecs_to_quats, rotvec)
        expected = torch.zeros(4, 3, dtype=torch.float64)
        expected[1:] = 0.5 * torch.eye(3, dtype=torch.float64)
        expected[0, 0] = -0.25 * size
        worst = max(worst, float((jacobian - expected).abs().max()))  # type: ignore[operator]
    return worst


def _half_turns(offset: float, dtype: type) -> float:
    """Largest error of quaternions recovered from matrices of rotations by almost pi, over 200 axes, rad."""
    axes = np.random.default_rng(1).normal(size=(200, 3))
    axes = np.concatenate([np.eye(3), -np.eye(3), axes / np.linalg.norm(axes, axis=-1, keepdims=True)])
    half = 0.5 * (math.pi - offset)
    quats = np.concatenate([np.full((len(axes), 1), math.cos(half)), math.sin(half) * axes], -1)
    rotmats = rotations.quats_to_rotmats(quats).astype(dtype)
    return angle(rotations.rotmats_to_quats(rotmats), quats)


def _angles(dtype: type) -> float:
    """Largest error of the angle between two orientations, from 0 to pi, rad."""
    axis, worst = np.array([0.36, 0.48, -0.8]), 0.0
    start = rotations.rotvecs_to_quats(np.array([0.3, -0.2, 0.5]))
    for x in (0.0, 1e-6, 1e-4, 1e-2, 1.0, math.pi - 1e-2, math.pi - 1e-4, math.pi - 1e-6, math.pi):
        p, q = start.astype(dtype), rotations.multiply(start, rotations.rotvecs_to_quats(x * axis)).astype(dtype)
        worst = max(worst, abs(float(rotations.angle_between(p, q)) - x))
    return worst


def _logarithm() -> float:
    """Largest error of a logarithm followed by an exponential, from no rotation to slightly over pi, rad."""
    axis, worst = np.array([0.36, 0.48, -0.8]), 0.0
    for x in (0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.1, 1.0, math.pi - 1e-4, math.pi - 1e-12, math.pi, math.pi + 1e-4):
        quat = rotations.rotvecs_to_quats(x * axis)
        for sign in (1, -1):
            worst = max(worst, angle(rotations.rotvecs_to_quats(rotations.quats_to_rotvecs(sign * quat)), quat))
    return worst


def _ten_turns() -> float:
    """Relative error of quaternion steps over ten turns of 20-degree steps, with the signs that matrices give."""
    step = math.radians(20)
    turns = step * np.arange(181)[:, None] * np.array([0.36, 0.48, -0.8])
    quats = rotations.rotmats_to_quats(rotations.quats_to_rotmats(rotations.rotvecs_to_quats(turns)))
    jumps = np.linalg.norm(np.diff(rotations.make_continuous(quats), axis=0), axis=-1)
    return float(np.abs(jumps / (2 * math.sin(step / 4)) - 1).max())


def _unit() -> float:
    """Deviation of normalised quaternions from unit length, plus that of a zero quaternion from the identity."""
    rng = np.random.default_rng(2)
    quats = rng.normal(size=(7, 1, 4)) * np.array([1e-150, 1e-30, 1e-6, 1, 1e6, 1e30, 1e150])[:, None, None]
    norms = np.linalg.norm(rotations.normalize(quats), axis=-1)
    zero = different(rotations.normalize(np.zeros(4)), rotations.identity())
    return float(np.abs(norms - 1).max()) + zero


def _rotating_keeps_lengths() -> float:
    """Largest relative change of the length of points rotated in float32."""
    quats = rotations.rotvecs_to_quats(np.random.default_rng(4).normal(size=(50, 1, 3))).astype(np.float32)
    turned = rotations.rotate(quats, body(1.0).astype(np.float32))
    return float(np.abs(np.linalg.norm(turned, axis=-1) - 1).max())


def _inverse() -> float:
    """Largest distance of points from their start after a rotation and its inverse."""
    quats = rotations.rotvecs_to_quats(10 * np.random.default_rng(5).normal(size=(50, 1, 3)))
    back = rotations.rotate(rotations.conjugate(quats), rotations.rotate(quats, body(1.0)))
    return max(largest(points - body(1.0)) for points in back)


_NAMES = ("sin(x)/x", "(1 - cos x)/x^2", "(x - sin x)/x^3")
_LIMITS = {np.float64: (1e-15, 1e-15, 2e-15), np.float32: (2e-7, 2e-7, 3e-7)}
_FUNCTIONS = ("sine_ratio", "versine_ratio", "remainder_ratio")


def _rounding(dtype: type) -> str:
    return f"rounding of {np.dtype(dtype).name}"


CASES: tuple[Case, ...] = (
    *(
        Case(
            "small angles",
            f"{_NAMES[i]} from 0, 1e-300 to 2 rad, {np.dtype(dtype).name}",
            f"motion.rotations.{_FUNCTIONS[i]}",
            "relative error",
            limits[i],
            "decimal arithmetic",
            functools.partial(_ratio, i, dtype),
        )
        for dtype, limits in _LIMITS.items()
        for i in range(3)
    ),
    Case(
        "small angles",
        "gradients of the exponential at 0, 1e-300 to 1e-4 rad",
        "motion.rotations.rotvecs_to_quats (torch)",
        "distance from the series",
        1e-9,
        "second order at 1e-4 rad",
        _gradients,
    ),
    Case(
        "small angles",
        "angle between orientations, float64",
        "motion.rotations.angle_between",
        "error (rad)",
        1e-15,
        ROUNDING,
        functools.partial(_angles, np.float64),
    ),
    Case(
        "small angles",
        "angle between orientations, float32",
        "motion.rotations.angle_between",
        "error (rad)",
        3e-7,
        _rounding(np.float32),
        functools.partial(_angles, np.float32),
    ),
    *(
        Case(
            "half turns",
            f"matrix to quaternion at pi{label}, {np.dtype(dtype).name}",
            "motion.rotations.rotmats_to_quats",
            "angle (rad)",
            tolerance,
            _rounding(dtype),
            functools.partial(_half_turns, offset, dtype),
        )
        for dtype, tolerance in ((np.float64, 1e-15), (np.float32, 3e-7))
        for label, offset in (("", 0.0), (" - 1e-6", 1e-6), (" - 1e-4", 1e-4), (" - 0.1", 0.1))
    ),
    Case(
        "half turns",
        "logarithm and exponential, 0 to pi + 1e-4 rad, both signs",
        "motion.rotations.quats_to_rotvecs",
        "angle (rad)",
        1e-15,
        ROUNDING,
        _logarithm,
    ),
    Case(
        "signs",
        "ten turns in steps of 20 degrees",
        "motion.rotations.make_continuous",
        "largest step / (2 sin 5 deg) - 1",
        1e-12,
        ROUNDING,
        _ten_turns,
    ),
    Case(
        "signs",
        "quaternions of length 0, 1e-150 to 1e150",
        "motion.rotations.normalize",
        "| |q| - 1 |",
        1e-15,
        ROUNDING,
        _unit,
    ),
    Case(
        "signs",
        "a turn and back",
        "motion.rotations.rotate, motion.rotations.conjugate",
        "distance / radius",
        1e-14,
        ROUNDING,
        _inverse,
    ),
    Case(
        "signs",
        "lengths of turned points, float32",
        "motion.rotations.rotate",
        "relative error",
        5e-7,
        _rounding(np.float32),
        _rotating_keeps_lengths,
    ),
)

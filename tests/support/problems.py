"""Motions with exact answers, and noisy observations of them."""

from __future__ import annotations

import numpy as np

from r5dgs_core.motion import knots, models, rotations
from r5dgs_core.motion.models import MotionModel

T_MAX = 0.75
RADIUS = 0.3
SIZE = 2 * RADIUS

# Name -> (motion about t_max, candidates that represent it exactly, plainest first).
MOTIONS: dict[str, tuple[MotionModel, tuple[str, ...]]] = {
    "static": (MotionModel(), ("static",)),
    "uniform": (MotionModel("translation", velocity=[0.5, 0, 0.2]), ("translation",)),
    "ballistic": (
        MotionModel("translation", velocity=[1, 0, -2], acceleration=[0, 0, -9]),
        ("translation, quadratic",),
    ),
    "ballistic, spinning": (
        MotionModel("ballistic_spin", velocity=[1, 0, -2], acceleration=[0, 0, -9], angular_velocity=[1, 2, 0.5]),
        ("ballistic + spin",),
    ),
    "spin": (MotionModel("ballistic_spin", angular_velocity=[1, 2, 0.5]), ("spin",)),
    "hinge": (
        MotionModel("ballistic_spin", angular_velocity=[0, 0, 2], center_offset=[0.5, 0, 0]),
        ("constant twist", "hinge"),
    ),
    "hinge, accelerating": (
        MotionModel(
            "ballistic_spin", angular_velocity=[0, 0, 2], angular_acceleration=[0, 0, 1.5], center_offset=[0.5, 0, 0]
        ),
        ("hinge",),
    ),
    "rolling": (
        MotionModel("ballistic_spin", velocity=[0.9, 0, 0], angular_velocity=[0, 3, 0]),
        ("translation + spin",),
    ),
    "rolling, slowing": (
        MotionModel(
            "ballistic_spin",
            velocity=[0.5, 0, 0],
            acceleration=[-0.6, 0, 0],
            angular_velocity=[0, 1.7, 0],
            angular_acceleration=[0, -2, 0],
        ),
        ("ballistic + spin, accelerating",),
    ),
    "spin, accelerating": (
        MotionModel("ballistic_spin", angular_velocity=[1, 2, 0.5], angular_acceleration=[0.5, 1, 0.25]),
        ("spin, accelerating",),
    ),
    "free axis": (
        MotionModel(
            "ballistic_spin",
            velocity=[1, 0, -2],
            acceleration=[0, 0, -9],
            angular_velocity=[1, 2, 0.5],
            angular_acceleration=[-0.5, 1, 2],
        ),
        ("ballistic + spin, free axis",),
    ),
    "screw": (
        MotionModel("constant_twist", velocity=[1, 0, 0.3], angular_velocity=[0, 0, 2]),
        ("constant twist",),
    ),
    "pendulum": (
        MotionModel(
            "ballistic_spin",
            angular_velocity=[0, 0.9, 0.3],
            angular_acceleration=[0, -3.6, -1.2],
            center_offset=[0.2, -0.2, 0.6],
            frequency=5.0,
        ),
        ("pendulum",),
    ),
    "spring": (
        MotionModel("translation", velocity=[0.3, 0.1, -0.9], acceleration=[0, 0.4, 6.0], frequency=8.0),
        ("spring",),
    ),
    "damped spring": (
        MotionModel("translation", velocity=[0.3, 0.1, -0.9], acceleration=[0, 0.4, 6.0], frequency=9.0, damping=1.5),
        ("damped spring",),
    ),
    "damped pendulum": (
        MotionModel(
            "ballistic_spin",
            angular_velocity=[0, 0.9, 0.3],
            angular_acceleration=[0, -3.6, -1.2],
            center_offset=[0.2, -0.2, 0.6],
            frequency=9.0,
            damping=1.2,
        ),
        ("damped pendulum",),
    ),
    "drag": (
        MotionModel("drag", velocity=[0.4, 0.1, -0.2], angular_velocity=[0.5, -1, 0.3], damping=3.0),
        ("drag",),
    ),
    "fall with drag": (
        MotionModel(
            "drag", velocity=[0.4, 0, -0.9], acceleration=[0, 0, -6], angular_velocity=[0.5, -1, 0.3], damping=2.5
        ),
        ("fall with drag",),
    ),
    "sliding friction": (
        MotionModel("friction", velocity=[0.5, -0.2, 0.1], stop_time=0.45),
        ("slide, friction",),
    ),
    "rolling friction": (
        MotionModel("friction", velocity=[0.5, 0, 0], angular_velocity=[0, 1.7, 0], stop_time=0.6),
        ("slide + turn, friction",),
    ),
    "precession": (
        MotionModel("precession", angular_velocity=[0.5, 1.5, 6.0], precession=[0, 0, 3], center_offset=[0.1, 0, -0.4]),
        ("precession",),
    ),
    "two oscillations": (
        MotionModel(
            "two_oscillations",
            velocity=[1, 0.5, 0],
            acceleration=[5, -20, 3],
            frequency=9.0,
            second_velocity=[-1, 2, 1],
            second_acceleration=[0, 30, -20],
            second_frequency=14.0,
            angular_velocity=[0, 1, 1],
            angular_acceleration=[0, -6, -6],
        ),
        ("two oscillations, rocking",),
    ),
}


# A ball before its next bounce. Earlier bounces are not part of the model.
BOUNCING = MotionModel(
    "bounce",
    velocity=[0.4, 0.3, -0.6],
    acceleration=[0, 0, -14],
    angular_velocity=[1, 0.5, -0.4],
    bounce_time=0.11,
    restitution=0.8,
    radius=RADIUS,
)
# A thrown box that tumbles; it needs the inertia of the body to be told from others.
TUMBLING = MotionModel(
    "free_top",
    velocity=[1, 0, -2],
    acceleration=[0, 0, -9],
    angular_velocity=[3.0, 3.5, -1.5],
    inertia=[[0.40, 0.02, 0.0], [0.02, 0.80, -0.03], [0.0, -0.03, 1.0]],
    radius=RADIUS,
)


# A box that is thrown, hits the floor at 0.5 and goes on with another spin.
_TURNS = rotations.rotvecs_to_quats(np.array([[0, 0, 0], [0.5, 1.0, 0.2], [0.1, 1.9, 0.0]]))
_PLACES = np.array([[0, 0, 0], [0.5, 0.1, -0.6], [0.7, 0.1, -0.5]])
_SPEEDS = np.array([[1, 0.2, 0.3], [1, 0.2, -2.5], [0.5, 0, -0.6]]), np.array([[1, 0.2, 0.3], [0.5, 0, 0.9], [0, 1, 0]])
_SPINS = np.array([[1, 2, 0.5], [1, 2, 0.5], [-1, 2.5, 0]]), np.array([[1, 2, 0.5], [-1, 3, 0], [0, 1, 0]])
TOSSED = MotionModel(
    "trajectory", radius=RADIUS, knots=knots.pack(np.array([0.0, 0.5, 0.9]), (_TURNS, _PLACES), _SPEEDS, _SPINS)
)


def observe(
    model: MotionModel,
    times: np.ndarray,
    rng: np.random.Generator,
    sigma_t: float = 0.0,
    sigma_r: float = 0.0,
    correlation: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses of a motion relative to the last observed one, with noise.

    Args:
        model: True motion about t_max = times[-1].
        times: [S]
        rng: Of the noise.
        sigma_t: Noise of displacements, per component.
        sigma_r: Noise of rotations, per component, rad.
        correlation: Of the noise with its predecessor.

    Returns:
        Quaternions [S, 4] and displacements [S, 3] relative to the last pose, and that pose in the true frame: its
        quaternion [4] and displacement [3].
    """
    quats, displacements, _, _ = models.curve(model, times - times[-1])
    noise = rng.normal(size=(len(times), 6))
    for i in range(1, len(times)):
        noise[i] = correlation * noise[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
    quats = rotations.multiply(rotations.rotvecs_to_quats(sigma_r * noise[:, 3:]), quats)
    displacements = displacements + sigma_t * noise[:, :3]
    last = quats[-1]
    relative = rotations.multiply(quats, rotations.conjugate(last))
    return relative, displacements - displacements[-1], last, displacements[-1]


def future_points(model: MotionModel, tau: np.ndarray, last_quat: np.ndarray, last: np.ndarray) -> np.ndarray:
    """True places of points of the body at t_max + tau, that `predicted_points` should give. [T, 26, 3]"""
    quats, displacements, _, _ = models.curve(model, tau)
    relative = rotations.multiply(quats, rotations.conjugate(last_quat))
    return _move(relative, displacements - last)


def predicted_points(model: MotionModel, tau: np.ndarray) -> np.ndarray:
    """The same points, moved by a fitted model. [T, 26, 3]"""
    return _move(*models.evaluate(model, tau))


def _move(quats: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    grid = grid[np.linalg.norm(grid, axis=-1) > 0]
    points = RADIUS * grid / np.linalg.norm(grid, axis=-1, keepdims=True)
    return rotations.rotate(quats[:, None], points[None]) + displacements[:, None]


def error_percent(model: MotionModel, truth: MotionModel, tau: np.ndarray, last_quat: np.ndarray, last: np.ndarray):
    """Root mean square error of the points at each tau, in percent of the body's size. [T]"""
    difference = predicted_points(model, tau) - future_points(truth, tau, last_quat, last)
    return 100 / SIZE * np.sqrt((difference**2).sum(-1).mean(-1))

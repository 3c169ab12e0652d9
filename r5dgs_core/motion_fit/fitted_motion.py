"""A fitted candidate as a motion model in world units, with its covariance and the error band of its future.

Notation: P parameters, S poses, H times past t_max.
"""

from __future__ import annotations

import numpy as np

from ..motion import models, rotations
from . import candidates as families
from .candidates import Solution, Track

FADE_PER_SPAN = 0.1 / 0.75
_RATES = ("velocity", "acceleration", "angular_velocity", "angular_acceleration")


def to_model(
    solution: Solution, radius: float, span: float, track: Track, sigmas: tuple[float, float]
) -> models.MotionModel:
    """Motion model in world units and units of time, with the covariance of its rates."""
    rates = _rates(solution, solution.theta, radius, span)
    step = 1e-6
    shifted = solution.theta + step * np.eye(len(solution.theta))
    moved = _rates(solution, shifted, radius, span)
    names = (*_RATES, *(["frequency"] if solution.candidate.oscillates else []))
    slopes = np.concatenate([(moved[name] - rates[name]) / step for name in names], axis=-1).T
    frequency = float(rates.pop("frequency")[0])
    inertia = None
    if solution.candidate.inertia is not None and models.KINDS[solution.candidate.kind].needs_inertia:
        turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(rates["offset_rotvec"]))
        inertia = turn @ solution.candidate.inertia @ turn.T
    spread = slopes @ covariance(solution, track, sigmas) @ slopes.T
    return models.MotionModel(
        kind=solution.candidate.kind,
        **rates,
        frequency=frequency,
        inertia=inertia,
        fade_time=FADE_PER_SPAN * span,
        radius=radius,
        covariance=0.5 * (spread + spread.T),
        covariance_names=(*(f"{name}.{axis}" for name in _RATES for axis in "xyz"), *names[len(_RATES) :]),
    )


def covariance(solution: Solution, track: Track, sigmas: tuple[float, float]) -> np.ndarray:
    """Covariance of the parameters, inflated for residuals that are correlated in time (AR(1)). [P, P]"""
    size, count = len(solution.theta), len(track.tau)
    values = families.residuals(solution.candidate, solution.theta[None], track, sigmas)[0]
    s2 = max(solution.chi2 * 6 * count / max(6 * count - size, 1), 1e-12)
    energy = float((values**2).sum())
    lag = float((values[1:] * values[:-1]).sum()) / energy if energy > 0 else 0.0
    rho = min(max(lag + (size / 6 + 1) / count, 0.0), 0.9)
    return s2 * (1 + rho) / (1 - rho) * np.linalg.pinv(solution.normal, hermitian=True)


def band(
    chosen: Solution,
    near: list[Solution],
    track: Track,
    sigmas: tuple[float, float],
    radius: float,
    span: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Two standard deviations of the position of a surface point, up to one observed span past t_max."""
    tau = np.linspace(0.0, 1.0, 17)
    candidate, theta = chosen.candidate, chosen.theta
    quats, displacements = (x[0] for x in candidate.poses(theta[None], tau))
    step = 1e-5
    moved_quats, moved = candidate.poses(theta + step * np.eye(len(theta)), tau)
    turns = rotations.quats_to_rotvecs(rotations.multiply(moved_quats, rotations.conjugate(quats)))
    slopes = np.concatenate([moved - displacements, turns], axis=-1) / step  # [P, H, 6]
    spread = np.einsum("phc,pq,qhc->hc", slopes, covariance(chosen, track, sigmas), slopes)
    # Mean over a sphere of |dd + dtheta x r|^2, r of length one radius: |dd|^2 + 2/3 |dtheta|^2. The bind state is one
    # of the poses and as noisy as the others, hence the last two terms.
    variance = spread[:, :3].sum(-1) + 2 / 3 * spread[:, 3:].sum(-1) + 3 * sigmas[0] ** 2 + 2 * sigmas[1] ** 2
    others = [s for s in near if s.candidate.name != candidate.name]
    total = sum(1 / s.candidate.parameters**2 for s in near) or 1.0
    for other in others:
        other_quats, other_displacements = (x[0] for x in other.candidate.poses(other.theta[None], tau))
        angle = rotations.angle_between(other_quats, quats)
        distance2 = ((other_displacements - displacements) ** 2).sum(-1) + 2 / 3 * angle**2
        variance = variance + distance2 / (other.candidate.parameters**2 * total)
    return tau * span, 2 * radius * np.sqrt(variance)


def _rates(solution: Solution, theta: np.ndarray, radius: float, span: float) -> dict[str, np.ndarray]:
    """Parameters converted to world units and units of time. [..., P] -> [..., 3] each"""
    p = solution.candidate.unpack(theta)
    return {
        "velocity": p["v"] * radius / span,
        "acceleration": p["a"] * radius / span**2,
        "angular_velocity": p["w"] / span,
        "angular_acceleration": p["eps"] / span**2,
        "center_offset": p["u"] * radius,
        "offset_rotvec": p["r"],
        "offset_displacement": p["e"] * radius,
        "frequency": p["frequency"] / span,
    }

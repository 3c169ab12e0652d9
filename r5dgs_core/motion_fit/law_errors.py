"""Errors of a fitted law that no other candidate shows: the swing of a pendulum, and hits in very short tracks.

Notation: H times past t_max; squares are in squared radii and rad^2.
"""

from __future__ import annotations

import numpy as np

from ..motion import rotations
from ..motion.models.base import LOGARITHMS
from ..motion.pose_track import PoseTrack
from . import candidates as families
from .candidates import FittedCandidate, Noise

SHORT = 5  # number of poses below which no break is fitted
_THIRD = 1 / 192  # amplitude of a pendulum's third harmonic over the cube of the amplitude of its swing, rad
_STEP = 1e-5


def squares(chosen: FittedCandidate, track: PoseTrack, noise: Noise, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean squared errors of the predicted positions and rotations that the candidates do not show. [H] each

    Args:
        chosen: The chosen solution.
        track: The poses that it was fitted to.
        noise: Their noise.
        tau: Times past t_max. [H]
    """
    change = np.zeros((len(tau), 6))
    if chosen.candidate.law is chosen.candidate and "swing" in chosen.candidate.rows:
        change = _pendulum(chosen, track, noise, tau)
    elif 2 <= len(track) < SHORT:
        change = _hit(chosen, track, tau)
    return (change[:, :3] ** 2).sum(-1), (change[:, 3:] ** 2).sum(-1)


def _hit(chosen: FittedCandidate, track: PoseTrack, tau: np.ndarray) -> np.ndarray:
    """Changes of the prediction if the body was hit before the last two poses, so that it moves on as between them."""
    step = track.tau[-1] - track.tau[-2]
    quats, d = chosen.candidate.law.path(chosen.law_theta, tau)
    way = (track.displacements[-1] - track.displacements[-2]) * tau[:, None] / step
    turn = rotations.quats_to_rotvecs(rotations.multiply(track.quats[-1], rotations.conjugate(track.quats[-2])))
    line = rotations.multiply(rotations.rotvecs_to_quats(turn * tau[:, None] / step), track.quats[-1])
    turned = rotations.quats_to_rotvecs(rotations.multiply(line, rotations.conjugate(quats)))
    return np.concatenate([track.displacements[-1] + way - d, turned], axis=-1)


def _pendulum(chosen: FittedCandidate, track: PoseTrack, noise: Noise, tau: np.ndarray) -> np.ndarray:
    """Changes of the prediction by the third harmonic of a pendulum, which a fitted swing about an axis lacks. [H, 6]

    The poses do not tell if a body hangs under gravity or turns against a spring, so this counts as a deviation of
    unknown sign. The fitted parameters follow the harmonic in the observed poses, and continue what they follow.

    Source: Lindstedt-Poincare expansion of the pendulum to third order.
    """
    count, theta = len(track), chosen.theta
    change = _harmonic(chosen, np.concatenate([track.tau, tau]))
    scaled = change[:count] / np.repeat([noise.place, noise.turn], 3)
    slopes = -families.linearized(chosen.candidate, theta, track, noise)[1]  # of the poses in units of the noise
    weights = (chosen.weights * chosen.robust)[:, None]
    followed = chosen.inverse @ np.einsum("psc,sc->p", slopes, weights * scaled)
    return change[count:] - _slope(chosen, followed, tau)


def _harmonic(solution: FittedCandidate, tau: np.ndarray) -> np.ndarray:
    """Changes of displacements and rotations, relative to t_max, by the third harmonic at some times. [S, 6]"""
    candidate, theta = solution.candidate, solution.theta
    parts = candidate.parts(theta)
    size, phase = float(np.linalg.norm(parts["swing"])), float(parts["phase"][0])
    if size == 0:
        return np.zeros((len(tau), 6))
    decay = float(np.exp(np.clip(parts["decay"][0], *LOGARITHMS))) if "decay" in parts else 0.0
    shrink, angle = np.exp(-decay * tau), float(candidate.window.frequency(parts["pace"])[0]) * tau + phase
    along, later = np.zeros(len(theta)), np.zeros(len(theta))
    along[candidate.rows["swing"]], later[candidate.rows["phase"]] = parts["swing"] / size, 1.0
    # The pose depends on the angle alone, which both parameters change: the amplitude by a, the phase by b.
    a = shrink * np.sin(angle) - np.sin(phase)
    b = size * (shrink * np.cos(angle) - np.cos(phase))
    both = a[:, None] * _slope(solution, along, tau) + b[:, None] * _slope(solution, later, tau)
    per_angle = both / np.maximum(a * a + b * b, 1e-12)[:, None]
    third = _THIRD * size**3 * (shrink**3 * np.sin(3 * angle) - np.sin(3 * phase))
    return third[:, None] * per_angle


def _slope(solution: FittedCandidate, direction: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Derivative of the displacements and rotation vectors along a direction of the parameters. [S, 6]"""
    quats, d = solution.candidate.path(solution.theta, tau)
    moved_quats, moved = solution.candidate.path(solution.theta + _STEP * direction, tau)
    turns = rotations.quats_to_rotvecs(rotations.multiply(moved_quats, rotations.conjugate(quats)))
    return np.concatenate([moved - d, turns], axis=-1) / _STEP

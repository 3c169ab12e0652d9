"""Motion of single Gaussians: residuals in the observed time, dynamics of their own past t_max.

Notation: R rows with residuals, S knots. A residual changes a Gaussian in the bind state, x -> x + offset,
q -> turn q, log scale -> log scale + growth; its group moves the result. Between knots each component is the curve of
`keyframes.slopes`, as for the tracks.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..motion import dynamics, keyframes, rotations
from .scene import Scene

TOLERANCE = 1e-5  # error of `standard` motion as a share of the scene's extent


def deformed(scene: Scene, t: float) -> tuple[Scene, np.ndarray | None]:
    """The scene with its bind state as the residuals have it at a time up to t_max.

    Returns:
        The scene, itself where it has no residuals then, and their rotations, unit wxyz [R, 4], or None.
    """
    rows = scene.residual_rows
    parts = (scene.residual_offsets, scene.residual_quats, scene.residual_log_scales)
    if rows is None or len(rows) == 0 or t >= scene.t_max or any(part is None for part in parts):
        return scene, None
    offsets, turns, growths = (_at(scene.track_times, part, t) for part in parts if part is not None)
    means, quats, log_scales = scene.means.copy(), scene.quats.copy(), scene.log_scales.copy()
    means[rows] += offsets
    turns = rotations.normalize(turns)
    quats[rows] = rotations.multiply(turns, quats[rows].astype(np.float64))
    log_scales[rows] += growths
    return dataclasses.replace(scene, means=means, quats=quats, log_scales=log_scales), turns


def _at(times: np.ndarray, values: np.ndarray, t: float) -> np.ndarray:
    """Curves through knots at a time, held before the first one. [R, S, C] -> [R, C] float64"""
    if t <= times[0] or len(times) == 1:
        return values[:, 0].astype(np.float64)
    k = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
    window = slice(max(k - 1, 0), min(k + 3, len(times)))  # a slope asks for the neighbours of its knot alone
    near = values[:, window].astype(np.float64)
    if values.shape[-1] == 4:
        flip = np.cumprod(np.where((near[:, 1:] * near[:, :-1]).sum(-1) < 0, -1.0, 1.0), axis=1)
        near[:, 1:] *= flip[..., None]
    rates = keyframes.slopes(times[window], near)
    i, h = k - window.start, times[k + 1] - times[k]
    return keyframes.hermite(near[:, i], near[:, i + 1], rates[:, i], rates[:, i + 1], h, (t - times[k]) / h)


def standard(scene: Scene, tau: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every Gaussian by its own dynamics, ``tau`` after t_max.

    Returns:
        Means [N, 3] float32, quats [N, 4] float32, and rotations since t_max [N, 4] float64.
    """
    assert scene.dynamics is not None
    turns, moves = dynamics.propagate(scene.dynamics, tau, TOLERANCE * scene.extent)
    means = (scene.means + moves).astype(np.float32)
    return means, rotations.multiply(turns, scene.quats.astype(np.float64)).astype(np.float32), turns


def literal(scene: Scene, tau: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eq. 6 and 7 of the paper to the letter, ``tau`` after t_max; groups that are no bodies stay.

    x_i = y_i + (p_r - y_r) + (R - I) (x_i - x_r) with y the state at t_max, x the canonical one and r the group's
    representative, which moves by its own dynamics and TRACE's integrator. This is not rigid where the object turned
    between the canonical time and t_max; `playback` has the form that is.

    Returns:
        As `standard`.
    """
    assert scene.dynamics is not None and scene.canonical_means is not None
    means, quats = scene.means.astype(np.float64), scene.quats.astype(np.float64)
    turns = rotations.identity(len(means))
    step = dynamics.TRACE_STEP * dynamics.time_unit(float(scene.track_times[0]), scene.t_max)
    for group in scene.groups:
        rows = np.flatnonzero(scene.motion_ids == group.id)
        r = group.anchor_index
        if group.role != "body" or r < 0:
            continue
        v, w, a, e = np.split(scene.dynamics[r].astype(np.float64), 4)
        moved, turn = dynamics.rk2(np.zeros(3), v, w, a, e, tau, step)
        offsets = scene.canonical_means[rows].astype(np.float64) - scene.canonical_means[r]
        means[rows] += moved + rotations.rotate(turn, offsets) - offsets
        turns[rows] = turn
    return means.astype(np.float32), rotations.multiply(turns, quats).astype(np.float32), turns

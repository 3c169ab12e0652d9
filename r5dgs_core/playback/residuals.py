"""Motion of individual Gaussians: residuals in the observed time, own dynamics past t_max.

Notation: R rows with residuals, S knots. A residual changes a Gaussian in the bind state, x -> x + offset, q -> turn q,
log scale -> log scale + growth; its group moves the result. Between knots each component is a cubic with the slopes of
`cubic_curves.slopes`, as for the tracks.
"""

from __future__ import annotations

import numpy as np

from ..motion import cubic_curves, midpoint_path, point_dynamics, quaternion_columns, rotations, twist_propagation
from ..scene.row_runs import runs
from ..scene.scene import Scene
from . import group_dynamics
from .posing import Poser

TOLERANCE = 1e-5  # allowed error of `standard` motion / extent of the scene
ANGLE_TOLERANCE = 1e-3  # allowed error of its rotations, rad
Cubic = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # values and slopes at both ends
UNEXPLAINED = 0.3  # in radii of the group; larger residuals are not explained by group motion


class Residuals:
    """Residuals of a scene at any time, stored by column. The last interval is cached.

    Attributes:
        rows: Gaussians with residuals, increasing. [R]
        runs: Ranges of ``rows`` in one motion group: start, stop, group.
        bind_quats: Their rotations in the bind state, unit wxyz, by column. [4, R]
    """

    def __init__(self, scene: Scene):
        found = scene.residuals
        self.rows = np.zeros(0, np.int64) if found is None else np.asarray(found.rows, np.int64)
        parts = () if found is None else (found.offsets, found.quats, found.log_scales)
        # [C, S, R]: the values of one knot are contiguous.
        self._parts = [np.ascontiguousarray(part.transpose(2, 1, 0)) for part in parts]
        self.runs = runs(scene.gaussians.motion_ids[self.rows])
        self.bind_quats = np.ascontiguousarray(scene.gaussians.quats[self.rows].T)
        self._times, self._t_max = scene.tracks.times, scene.t_max
        self._interval: tuple[int, list[Cubic]] | None = None

    def at(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Offsets [3, R], unit quaternions wxyz [4, R] and changes of log scales [3, R] at a time, float64.

        Returns:
            The three, constant before the first knot; None from t_max on or if there are no residuals.
        """
        if len(self.rows) == 0 or t >= self._t_max:
            return None
        times = self._times
        if t <= times[0]:
            offsets, turns, growths = (part[:, 0].astype(np.float64) for part in self._parts)
            return offsets, _unit(turns), growths
        k, h, u = cubic_curves.locate(times, t)
        if self._interval is None or self._interval[0] != k:
            self._interval = int(k), [_cubic(times, part, int(k)) for part in self._parts]
        offsets, turns, growths = (
            cubic_curves.hermite(a, b, left, right, h, u) for a, b, left, right in self._interval[1]
        )
        return offsets, _unit(turns), growths


def _unit(quats: np.ndarray) -> np.ndarray:
    """Normalise quaternions by column. [4, R]"""
    return quats / np.sqrt(np.maximum((quats * quats).sum(0), 1e-300))


def _cubic(times: np.ndarray, values: np.ndarray, k: int) -> Cubic:
    """Values and slopes at both ends of interval k of curves through knots. [C, S, R] -> four times [C, R] float64"""
    window = slice(max(k - 1, 0), min(k + 3, len(times)))  # a slope depends only on the neighbouring knots
    near = values[:, window].astype(np.float64)
    if len(values) == 4:
        near[:, 1:] *= np.cumprod(np.where((near[:, 1:] * near[:, :-1]).sum(0) < 0, -1.0, 1.0), axis=0)
    rates, i = cubic_curves.slopes(times[window], near), k - window.start
    return near[:, i], near[:, i + 1], rates[:, i], rates[:, i + 1]


def unexplained(scene: Scene) -> np.ndarray:
    """Gaussians that no group's motion explains, for mode "hybrid": increasing rows. [H] int64

    Their root mean square offset over the knots exceeds `UNEXPLAINED` radii of their group. In a pinned group any
    residual suffices.
    """
    if scene.residuals is None or len(scene.residuals.rows) == 0:
        return np.zeros(0, np.int64)
    rows, offsets = scene.residuals.rows, scene.residuals.offsets
    limits = np.array([0.0 if g.role == "pinned" else UNEXPLAINED * g.model.radius for g in scene.groups])
    away = np.sqrt(np.einsum("rsc,rsc->r", offsets, offsets, dtype=np.float64) / offsets.shape[1])
    return rows[away > limits[scene.gaussians.motion_ids[rows]]].astype(np.int64)


class OwnMotion:
    """Gaussians that move by their own dynamics past t_max.

    Args:
        scene: The scene, with `point_dynamics`.
        rows: These Gaussians; None for all.
    """

    def __init__(self, scene: Scene, rows: np.ndarray | None = None):
        assert scene.dynamics is not None
        chosen = np.arange(len(scene.gaussians.means)) if rows is None else rows
        tolerance = TOLERANCE * scene.extent
        self._propagator = twist_propagation.Propagator(
            scene.dynamics.rates[chosen], tolerance, radius=tolerance / ANGLE_TOLERANCE
        )
        moving = self._propagator.rows
        # Among chosen rows, those at rest are listed too; otherwise their groups would move them.
        self._resting = np.zeros(0, np.int64) if rows is None else np.setdiff1d(np.arange(len(chosen)), moving)
        self.rows = chosen[np.concatenate([moving, self._resting])]
        self._means = np.ascontiguousarray(scene.gaussians.means[self.rows].T, np.float64)
        self._quats = np.ascontiguousarray(scene.gaussians.quats[self.rows].T)

    def at(self, tau: float, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means relative to the origin [3, R], quats [4, R] and rotations since t_max [4, R], by column."""
        turns, moves = self._propagator.columns(tau)
        if len(self._resting):
            still = rotations.identity(len(self._resting)).T
            turns, moves = np.hstack([turns, still]), np.hstack([moves, 0 * still[1:]])
        moves += self._means
        moves -= origin[:, None]
        moves.clip(-group_dynamics.FARTHEST, group_dynamics.FARTHEST, out=moves)
        turns = turns.astype(np.float32)
        return moves, quaternion_columns.multiply(turns, self._quats), turns


class LiteralPaperMotion:
    """Literal form of Eq. 6 and 7 of the paper.

    x_i = y_i + (p_r - y_r) + (R - I) (x_i - x_r) with y the state at t_max, x the canonical one and r the group's
    representative, which moves by its own dynamics and TRACE's integrator. This is not rigid if the object rotated
    between the canonical time and t_max; `scene_player` has the rigid form.

    Args:
        scene: The scene, with `point_dynamics` and `canonical_means`.
        anchored: True to give Gaussians outside bodies a representative too, as in the paper's text; otherwise they
            stay in place.
    """

    def __init__(self, scene: Scene, anchored: bool = False):
        assert scene.dynamics is not None and scene.dynamics.canonical_means is not None
        anchors = np.array([g.anchor_index if g.role == "body" else -1 for g in scene.groups])
        loose = np.flatnonzero(np.isin(scene.gaussians.motion_ids, [g.id for g in scene.groups if g.role != "body"]))
        if anchored and len(loose):
            anchors[[g.role != "body" for g in scene.groups]] = group_dynamics.representative(scene, loose)
        self._moving = np.flatnonzero(anchors >= 0)
        self._anchors = anchors[self._moving]
        v, w, a, e = np.split(scene.dynamics.rates[self._anchors].astype(np.float64), 4, axis=-1)
        step = point_dynamics.TRACE_STEP * point_dynamics.time_unit(float(scene.tracks.times[0]), scene.t_max)
        self._path = midpoint_path.MidpointPath(np.zeros_like(v), v, w, a, e, step)
        canonical = scene.dynamics.canonical_means.astype(np.float64)
        self._offsets = np.ones((len(canonical), 4))
        self._offsets[:, :3] = canonical - canonical[np.maximum(anchors, 0)[scene.gaussians.motion_ids]]
        self._count = len(scene.groups)

    def at(self, tau: float) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [G, 4] and displacements [G, 3] of the representatives."""
        quats, displacements = rotations.identity(self._count), np.zeros((self._count, 3))
        displacements[self._moving], quats[self._moving] = self._path.at(tau)
        return quats, displacements.clip(-group_dynamics.FARTHEST, group_dynamics.FARTHEST)

    def means(self, poser: Poser, quats: np.ndarray, displacements: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Centres relative to an origin, for the result of `at`. [N, 3] float32"""
        maps = np.empty((self._count, 4, 3))
        maps[:, :3] = np.swapaxes(rotations.quats_to_rotmats(quats), -1, -2) - np.eye(3)
        maps[:, 3] = displacements
        return poser.shift(self._offsets, maps, origin)

"""Playback of a scene: poses of its motion groups and its Gaussians at any time.

Between the observed times each component of displacement and quaternion is a cubic Hermite curve through the knots (the
quaternion is normalised afterwards), with slopes of the parabola through each knot and its two neighbours. Blender's
Bezier keys with handles at a third of the interval are the same curve, so keys at the knots reproduce playback at
sub-frames. Before the first knot the pose is held; past t_max it depends on the mode.

A mode is one string, BASE or BASE/VARIANT; the variant defaults to the first of `VARIANTS`. All modes agree up to
t_max. Past it:

- "rigid" moves every Gaussian with its group. The variant is the source of the group's motion (`group_dynamics`).
- "hybrid" is "rigid", except that Gaussians which no group's motion explains (`residuals.unexplained`) move by their
  own dynamics.
- "standard" moves every Gaussian by its own dynamics.
- "rigid_paper" is the literal form of Eq. 6 and 7. Gaussians outside bodies stay in place with "pinned"; with
  "anchored" they get a representative, as in the paper's text.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np

from ..motion import quaternion_columns, rotations
from ..scene import presence
from ..scene.scene import Scene
from . import group_dynamics, posing
from .modes import every, split
from .residuals import LiteralPaperMotion, OwnMotion, Residuals, unexplained


@dataclass(frozen=True)
class Frame:
    """The Gaussians of a scene at time t.

    `sh` stays in the frame of the bind state: a renderer rotates each viewing direction back by the group's rotation
    (`sh_rotations`), or by the Gaussian's own, instead of rotating the coefficients.

    Attributes:
        t: Scene time.
        means: Centres relative to ``origin``, along the world's axes. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Logarithms of the scales. [N, 3] float32
        opacity_logits: As in the scene; `presence.HIDDEN` for groups that are absent then. [N] float32
        sh: As in the scene, bind frame. [N, K, 3] float32
        shading_factor: Factor on the colour, >= 0, or None without shading. [N] float32
        object_ids: As in the scene. [N] int32
        motion_ids: As in the scene. [N] int32
        group_quats: Rotation of each motion group since the bind state, unit wxyz. [G, 4] float64
        group_displacements: Displacement of each group's pivot, world. [G, 3] float64
        origin: Point of the world that ``means`` are relative to. [3] float64
        turned_rows: Gaussians with a rotation other than their group's, or None. [R] int64
        turned_quats: Their rotations since the bind state, unit wxyz, or None. [R, 4] float32
    """

    t: float
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    shading_factor: np.ndarray | None
    object_ids: np.ndarray
    motion_ids: np.ndarray
    group_quats: np.ndarray
    group_displacements: np.ndarray
    origin: np.ndarray
    turned_rows: np.ndarray | None = None
    turned_quats: np.ndarray | None = None


def modes(scene: Scene) -> tuple[str, ...]:
    """Modes of `every` that a scene has data for: `rigid` always, the others if it has dynamics."""
    return tuple(mode for mode in every() if available(scene, mode))


def available(scene: Scene, mode: str) -> bool:
    """Return True if a scene has data for a mode. Raises ValueError if the mode is unknown."""
    base, variant = split(mode)
    if base == "rigid_paper":
        return scene.dynamics is not None and scene.dynamics.canonical_means is not None
    return scene.dynamics is not None or (base == "rigid" and variant == "fitted")


class Player:
    """A scene in one mode, ready for any time. Time-independent quantities are computed lazily, once.

    Args:
        scene: The scene; its arrays must not change.
        mode: One of `modes`.

    Raises:
        ValueError: The mode is unknown, or the scene has no data for it.
    """

    def __init__(self, scene: Scene, mode: str = "rigid"):
        self.scene, self.mode = scene, mode
        self._base, self._variant = split(mode)
        if not available(scene, mode):
            raise ValueError(
                f"mode: expected one of {', '.join(modes(scene))} for the scene {scene.name!r}, got {mode!r}"
            )
        self._poser = posing.Poser(scene)
        source = self._variant if self._base in ("rigid", "hybrid") else "fitted"
        self._groups = group_dynamics.GroupMotion(scene, source)

    @functools.cached_property
    def _residuals(self) -> Residuals:
        return Residuals(self.scene)

    @functools.cached_property
    def _own(self) -> OwnMotion | None:
        if self._base == "standard":
            return OwnMotion(self.scene)
        rows = unexplained(self.scene) if self._base == "hybrid" else ()
        return OwnMotion(self.scene, np.asarray(rows)) if len(rows) else None

    @functools.cached_property
    def _literal(self) -> LiteralPaperMotion:
        return LiteralPaperMotion(self.scene, self._variant == "anchored")

    def group_poses(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Pose of every motion group in this mode, relative to the bind state.

        Returns:
            Unit quaternions wxyz [G, 4] and displacements of the pivots (of the representatives in mode "rigid_paper"),
            world [G, 3], float64; the identity in mode "standard" past t_max.
        """
        if t <= self.scene.t_max or self._base in ("rigid", "hybrid"):
            return self._groups.poses(t)
        if self._base == "rigid_paper":
            return self._literal.at(t - self.scene.t_max)
        return rotations.identity(len(self.scene.groups)), np.zeros((len(self.scene.groups), 3))

    def frame(self, t: float, origin: np.ndarray | None = None) -> Frame:
        """The scene's Gaussians at a time.

        Args:
            t: Scene time.
            origin: Point of the world that the centres are relative to, such as the camera position, near which float32
                is most precise; None for the world origin. [3]

        Returns:
            The frame. Without an origin, Gaussians that did not move equal the bind state exactly.
        """
        scene, poser, center = self.scene, self._poser, _checked_origin(origin)
        quats, displacements = self.group_poses(t)
        past = t > scene.t_max
        if past and self._base == "rigid_paper":
            means = self._literal.means(poser, quats, displacements, center)
        else:
            means = poser.means(quats, displacements, center)
        moved = _Moved(means, poser.quats(quats), scene.gaussians.log_scales, poser.shading(quats))
        if not past:
            self._apply_residuals(moved, t, quats, displacements, center)
        elif self._own is not None:
            self._apply_own_motion(moved, t - scene.t_max, center)
        return self._frame(t, moved, quats, displacements, center)

    def frame_after(self, other: Frame) -> Frame:
        """The frame at the time and origin of another frame, faster than by `frame` if few groups have other poses.

        Args:
            other: Frame in this mode of a scene that differs from this one in its tracks alone.
        """
        if other.t > self.scene.t_max or self.scene.residuals is not None:
            return self.frame(other.t, other.origin)
        quats, displacements = self.group_poses(other.t)
        groups = (quats != other.group_quats).any(-1) | (displacements != other.group_displacements).any(-1)
        return dataclasses.replace(
            other,
            means=self._poser.means(quats, displacements, other.origin, other.means, groups),
            quats=self._poser.quats(quats, other.quats, groups),
            shading_factor=self._poser.shading(quats, other.shading_factor, groups),
            group_quats=quats,
            group_displacements=displacements,
        )

    def _opacity_logits(self, t: float) -> np.ndarray:
        """Opacity logits at a time: those of the scene, and `presence.HIDDEN` for groups that are absent. [N]"""
        gaussians = self.scene.gaussians
        gone = presence.absent_rows([group.absent for group in self.scene.groups], gaussians.motion_ids, t)
        if gone is None:
            return gaussians.opacity_logits
        return np.where(gone, np.float32(presence.HIDDEN), gaussians.opacity_logits)

    def frame_at_poses(
        self,
        group_quats: np.ndarray,
        group_displacements: np.ndarray,
        t: float = float("nan"),
        origin: np.ndarray | None = None,
    ) -> Frame:
        """The scene's Gaussians with each motion group in a given pose.

        Args:
            group_quats: Rotation of each group about its pivot, unit wxyz. [G, 4]
            group_displacements: Displacement of each pivot, world. [G, 3]
            t: Time stored in the frame, at which groups may be absent; all are there if it is NaN.
            origin: As for `frame`.
        """
        poser, center = self._poser, _checked_origin(origin)
        means = poser.means(group_quats, group_displacements, center)
        log_scales = self.scene.gaussians.log_scales
        moved = _Moved(means, poser.quats(group_quats), log_scales, poser.shading(group_quats))
        return self._frame(t, moved, group_quats, group_displacements, center)

    def _frame(
        self, t: float, moved: _Moved, quats: np.ndarray, displacements: np.ndarray, origin: np.ndarray
    ) -> Frame:
        gaussians = self.scene.gaussians
        return Frame(
            t=float(t),
            means=moved.means,
            quats=moved.quats,
            log_scales=moved.log_scales,
            opacity_logits=self._opacity_logits(t),
            sh=gaussians.sh,
            shading_factor=moved.shading,
            object_ids=gaussians.object_ids,
            motion_ids=gaussians.motion_ids,
            group_quats=quats,
            group_displacements=displacements,
            origin=origin,
            turned_rows=moved.rows if self.scene.harmonics_turn else None,
            turned_quats=moved.turns if self.scene.harmonics_turn else None,
        )

    def _apply_residuals(
        self, moved: _Moved, t: float, quats: np.ndarray, displacements: np.ndarray, origin: np.ndarray
    ) -> None:
        """Apply residuals of the observed time in the bind state, before the group motion."""
        found = self._residuals.at(t)
        if found is None:
            return
        offsets, turns, growths = found
        rows, scene = self._residuals.rows, self.scene
        arms = self._poser.arms[rows]
        arms[:, :3] += offsets.T
        maps = self._poser.maps(quats, displacements, origin)
        for start, stop, g in self._residuals.runs:
            moved.means[rows[start:stop]] = arms[start:stop] @ maps[g]
        carried = np.take(quats.T.astype(np.float32), scene.gaussians.motion_ids[rows], axis=1)
        since = quaternion_columns.multiply(carried, turns.astype(np.float32))
        moved.turn(rows, since, quaternion_columns.multiply(since, self._residuals.bind_quats), scene)
        moved.log_scales = scene.gaussians.log_scales.copy()
        moved.log_scales[rows] += growths.T
        self._poser.relight(moved.shading, rows, since)

    def _apply_own_motion(self, moved: _Moved, tau: float, origin: np.ndarray) -> None:
        """Move Gaussians by their own dynamics past t_max."""
        assert self._own is not None
        means, quats, turns = self._own.at(tau, origin)
        moved.means[self._own.rows] = means.T
        moved.turn(self._own.rows, turns, quats, self.scene)
        self._poser.relight(moved.shading, self._own.rows, turns)


@dataclass
class _Moved:
    """Mutable state of a frame. means [N, 3], quats [N, 4], log_scales [N, 3], shading [N]; rows [R], turns [R, 4]"""

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    shading: np.ndarray | None
    rows: np.ndarray | None = None
    turns: np.ndarray | None = None

    def turn(self, rows: np.ndarray, since: np.ndarray, quats: np.ndarray, scene: Scene) -> None:
        """Set quaternions of some Gaussians and their rotations ``since`` the bind state, by column. [4, R]"""
        if self.quats is scene.gaussians.quats:
            self.quats = scene.gaussians.quats.copy()
        self.quats[rows] = quats.T
        self.rows, self.turns = rows, since.T


def _checked_origin(origin: np.ndarray | None) -> np.ndarray:
    """Copy an origin as float64, zeros if None. Raises ValueError unless it is three finite numbers. [3]"""
    center = np.zeros(3) if origin is None else np.array(origin, np.float64)
    if center.shape != (3,) or not np.isfinite(center).all():
        raise ValueError(f"origin: expected three finite numbers, got {origin!r}")
    return center


def sh_rotations(group_quats: np.ndarray) -> np.ndarray:
    """Matrices from world directions to each group's bind frame, for evaluating SH. [G, 4] -> [G, 3, 3]"""
    return np.swapaxes(rotations.quats_to_rotmats(group_quats), -1, -2)

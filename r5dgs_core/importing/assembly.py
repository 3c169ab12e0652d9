"""Assembly of a scene from an imported run: bind state at t_max, residuals at knots, dynamics past t_max, and objects.

All Gaussians belong to one pinned motion group; observed motion is stored as residuals.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..motion import models, rotations
from ..scene import scene
from ..scene.scene import Classifier, Dynamics, Gaussians, MotionGroup, Residuals, Scene, SceneObject, Tracks
from .foreign_run import ForeignRun, State

CHUNK = 16384  # rows per evaluation at all knots; bounds the memory
STILL = 1e-4  # maximum motion of a Gaussian's ellipsoid that is dropped, as a share of the scene's extent

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ImportedMotion:
    """Observed motion of N Gaussians of which R move. S knots.

    Attributes:
        bind: State of all Gaussians at the last knot.
        rows: Rows of the moving Gaussians, increasing. [R] int32
        offsets: Their displacement from the bind state. [R, S, 3] float32
        turns: Their rotation from the bind state, unit wxyz. [R, S, 4] float32
        growths: Change of their log scales. [R, S, 3] float32
        dynamics: Motion past the last knot. [N, 12] float32 or None
    """

    bind: State
    rows: np.ndarray
    offsets: np.ndarray
    turns: np.ndarray
    growths: np.ndarray
    dynamics: np.ndarray | None


def sample(
    foreign: ForeignRun, times: np.ndarray, tolerance: float, progress: Progress | None = None
) -> ImportedMotion:
    """Evaluate the deformation at the knots.

    Args:
        foreign: A run with a `state`.
        times: Knots, the last is t_max. [S]
        tolerance: Maximum motion of a static Gaussian's ellipsoid, world units.
        progress: Called with the number of finished Gaussians and their total.
    """
    assert foreign.state is not None
    count, last = len(foreign.splats.means), float(times[-1])
    kept: list[tuple[np.ndarray, ...]] = []
    binds, dynamics = [], []
    for start in range(0, max(count, 1), CHUNK):
        rows = slice(start, min(start + CHUNK, count))
        bind = foreign.state(rows, last)
        binds.append(bind)
        if foreign.dynamics is not None:
            dynamics.append(foreign.dynamics(rows, bind.means, last).astype(np.float32))
        parts = _relative([foreign.state(rows, float(t)) for t in times[:-1]], bind)
        moving = np.flatnonzero(_reach(bind, *parts) > tolerance)
        kept.append((moving + start, *(part[moving].astype(np.float32) for part in parts)))
        if progress is not None:
            progress(rows.stop, count)
    moved, offsets, turns, growths = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    bind = State(*(np.concatenate([getattr(b, name) for b in binds]) for name in ("means", "quats", "log_scales")))
    return ImportedMotion(
        bind, moved.astype(np.int32), offsets, turns, growths, np.concatenate(dynamics) if dynamics else None
    )


def _relative(states: list[State], bind: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets [n, S, 3], turns [n, S, 4] and growths [n, S, 3] from the bind state, which is appended as last knot."""
    states = [*states, bind]
    offsets = np.stack([state.means - bind.means for state in states], axis=1)
    growths = np.stack([state.log_scales - bind.log_scales for state in states], axis=1)
    back = rotations.conjugate(bind.quats)
    turns = rotations.make_continuous(np.stack([rotations.multiply(s.quats, back) for s in states])[::-1])[::-1]
    turns = np.where(turns[-1, :, :1] < 0, -turns, turns)
    turns[-1] = [1.0, 0.0, 0.0, 0.0]
    return offsets, np.swapaxes(turns, 0, 1), growths


def _reach(bind: State, offsets: np.ndarray, turns: np.ndarray, growths: np.ndarray) -> np.ndarray:
    """Upper bound on the motion of points on the one-sigma ellipsoid, relative to the bind state. [n]"""
    size = np.exp(bind.log_scales.max(-1))[:, None]
    angle = np.linalg.norm(rotations.quats_to_rotvecs(turns), axis=-1)
    stretch = np.abs(np.expm1(growths) * np.exp(bind.log_scales)[:, None]).max(-1)
    return (np.linalg.norm(offsets, axis=-1) + size * angle + stretch).max(-1, initial=0.0)


def make_scene(foreign: ForeignRun, motion: ImportedMotion | None, times: np.ndarray, **rest) -> Scene:
    """Assemble the scene.

    Args:
        motion: Result of `sample`, None for a static scene.
        times: Knots. [S]
        **rest: The fields of `Scene` that do not come from the run: name, frames_per_unit, world_convention, cameras,
            background_sh, provenance.
    """
    splats = foreign.splats
    labels, classifier = classify(foreign)
    order = np.argsort(labels, kind="stable")
    means, quats, log_scales = splats.means, splats.quats, splats.log_scales
    if motion is not None:
        means, quats, log_scales = motion.bind.means, motion.bind.quats, motion.bind.log_scales
    ranks = np.argsort(order)
    moved = None if motion is None or len(motion.rows) == 0 else np.argsort(ranks[motion.rows])
    residuals = None
    if motion is not None and moved is not None:
        residuals = Residuals(
            rows=ranks[motion.rows][moved].astype(np.int32),
            offsets=motion.offsets[moved],
            quats=motion.turns[moved],
            log_scales=motion.growths[moved],
        )
    identities = splats.identities
    if identities is not None and identities.shape[1] != scene.IDENTITY_DIM:
        identities = None
    group = MotionGroup(0, 0, "pinned", 0 if len(order) else -1, np.zeros(3), models.STATIC)
    return Scene(
        gaussians=Gaussians(
            means=means[order].astype(np.float32),
            quats=rotations.normalize(quats[order].astype(np.float64)).astype(np.float32),
            log_scales=log_scales[order].astype(np.float32),
            opacity_logits=splats.opacity_logits[order],
            sh=splats.sh[order],
            object_ids=labels[order],
            motion_ids=np.zeros(len(order), np.int32),
            identities=None if identities is None else identities[order].astype(np.float16),
        ),
        objects=_objects(labels[order]),
        groups=(group,),
        tracks=Tracks(times=times.astype(np.float64), poses=np.tile([1.0, 0, 0, 0, 0, 0, 0], (1, len(times), 1))),
        t_max=float(times[-1]),
        classifier=classifier,
        residuals=residuals,
        dynamics=None if motion is None or motion.dynamics is None else Dynamics(motion.dynamics[order]),
        near_plane=foreign.near_plane,
        harmonics_turn=False,
        **rest,
    )


def classify(foreign: ForeignRun) -> tuple[np.ndarray, Classifier | None]:
    """Assign each Gaussian to the class with its highest score, and reduce the classifier to the classes that occur.

    Returns:
        Object ids [N] int32, all 0 without a classifier; and the classifier of the M + 1 classes, or None.

    Source: Gaussian Grouping, whose class 0 is the unmasked background.
    """
    identities = foreign.splats.identities
    if foreign.classifier is None or identities is None:
        return np.zeros(len(foreign.splats.means), np.int32), None
    weight, bias = foreign.classifier
    labels = (identities @ weight.T + bias).argmax(-1).astype(np.int32)
    present = np.union1d(labels, [0])
    return labels, Classifier(weight[present].astype(np.float32), bias[present].astype(np.float32))


def _objects(labels: np.ndarray) -> tuple[SceneObject, ...]:
    """Object table of sorted labels: the background and "object k"."""
    table = []
    for k in np.union1d(labels, [0]).tolist():
        start, stop = np.searchsorted(labels, [k, k + 1]).tolist()
        color = (0.5, 0.5, 0.5) if k == 0 else colorsys.hls_to_rgb(k * 0.6180339887 % 1.0, 0.55, 0.9 - 0.25 * (k % 2))
        table.append(SceneObject(k, f"object {k}" if k else "background", (), "", color, start, stop - start))
    return tuple(table)

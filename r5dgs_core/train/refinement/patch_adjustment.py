"""Adjustment of poses and clocks to planar patches: bundle adjustment on the colours of the images.

The squared differences between the pictures of a patch, with robust weights, are minimised over the poses and clocks of
all cameras and the plane of each patch. The planes are eliminated from the normal equations (Schur complement), so
that, unlike in training, no shape of the scene holds a camera in a wrong place.

Notation: R poses, P patches, M pairs of a patch and a picture, K = 7 R parameters (pose and time of each camera).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...scene.camera_correction import COUNT, POSE, TIME, Correction
from ...scene.cameras import Camera
from . import patches
from .patches import HOST, SHAPE, TARGET, DepthView, Patches, Placed

FIRST, ROUNDS = 3, 8  # iterations of the planes alone, and of everything
ALIKE = (0.5, 0.8)  # least correlation of a pair that counts, in these
ROBUST = 3.0  # difference at which a pixel loses weight, standard deviations
CORRELATED = 20.0  # pixels that have one independent error
PRIOR_PX, PRIOR_SPACINGS = 3.0, 0.3  # standard deviations of the errors of poses and clocks
LARGEST = 0.1  # change of the depth of a patch in an iteration, relative
LEAST_PAIRS = 30  # of a camera
EACH = 7  # parameters of a camera


@dataclass(frozen=True, eq=False)
class Cameras:
    """Cameras of the pictures.

    Attributes:
        given: Each as given.
        corrections: Their present corrections.
        units: Corrections of a pixel, as from `gauge.pixel_units`. [R, 6, 6]
        spacing: Typical spacing of the observed times.
    """

    given: Sequence[Camera]
    corrections: Sequence[Correction]
    units: np.ndarray
    spacing: float

    def corrected(self) -> list[Camera]:
        """Return the cameras with their present corrections."""
        return [change.camera(camera) for change, camera in zip(self.corrections, self.given, strict=True)]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result of an adjustment.

    Attributes:
        changes: Change of each correction, as for `Correction.plus`. [R, COUNT]
        halves: Total corrections by each half of the patches. Two of [R, COUNT]
    """

    changes: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of the pairs.

    Attributes:
        matrix: J^T W J. [M, 17, 17]
        vector: J^T W r. [M, 17]
        deviation: Standard deviation of the differences.
    """

    matrix: np.ndarray
    vector: np.ndarray
    deviation: float


def adjust(depth_views: Sequence[DepthView], rig: Cameras, found: Patches, *, clocks: bool) -> Adjusted | None:
    """Adjust the cameras to the patches of their pictures.

    Args:
        depth_views: The pictures.
        rig: Their cameras.
        found: Patches of the pictures; they are not changed.
        clocks: True to adjust the clocks, too.

    Returns:
        The change; None if a camera shares too few patches with the others.
    """
    work = _Work(depth_views, rig, found, clocks)
    if not work.connected():
        return None
    for count, alike in zip((FIRST, ROUNDS), ALIKE, strict=True):
        for _ in range(count):
            work.step(work.equations(alike), cameras=count == ROUNDS)
    last = work.equations(ALIKE[1])
    if not work.connected():
        return None
    odd = work.found.patch % 2 == 1
    changes = work.total() - _numbers(rig.corrections)
    totals = [work.total() + work.solved(last, mine)[0] for mine in (odd, ~odd)]
    return Adjusted(_wide(changes), (_wide(totals[0]), _wide(totals[1])))


class _Work:
    """State of an adjustment."""

    def __init__(self, depth_views: Sequence[DepthView], rig: Cameras, found: Patches, clocks: bool):
        self._depth_views, self._rig = depth_views, rig
        self._corrections = list(rig.corrections)
        self.found = found
        self._planes = self.found.planes.copy()
        self._columns = EACH if clocks else EACH - 1
        self._active = np.ones(len(self.found.patch), bool)
        self._deviation = 0.0
        pose_of = np.array([one.pose for one in depth_views])
        places = pose_of[self.found.host[self.found.patch]], pose_of[self.found.target]
        self._places = [EACH * place[:, None] + np.arange(EACH) for place in places]
        count = EACH * len(rig.given)
        self._units = np.zeros((count, count))
        for row, unit in enumerate(rig.units):
            at = EACH * row
            self._units[at : at + 6, at : at + 6] = unit
            self._units[at + 6, at + 6] = rig.spacing

    def connected(self) -> bool:
        """True if all cameras share enough patches with others."""
        count = np.zeros(EACH * len(self._rig.given), int)
        for place in self._places:
            np.add.at(count, place[self._active], 1)
        return bool(count.min() >= LEAST_PAIRS)

    def total(self) -> np.ndarray:
        """Return the present corrections. [K]"""
        return _numbers(self._corrections)

    def equations(self, alike: float) -> _Equations:
        """Return the normal equations of all pairs, 0 for those that are less than ``alike``."""
        placed = [self._placed(one) for one in self._depth_views]
        size = SHAPE.stop
        matrix, vector = np.zeros((len(self.found.patch), size, size)), np.zeros((len(self.found.patch), size))
        host, target = self.found.host[self.found.patch], self.found.target
        sampled = []
        for pair in np.unique(np.stack([host, target], 1), axis=0).tolist():
            here = np.flatnonzero((host == pair[0]) & (target == pair[1]))
            which = self.found.patch[here]
            off, slopes, correlation = patches.differences(
                placed[pair[0]], placed[pair[1]], self.found.centers[which], self._planes[which]
            )
            self._active[here] = correlation > alike
            off, slopes = off[correlation > alike], slopes[correlation > alike]
            here = here[correlation > alike]
            sampled.append(np.abs(off[:, ::7]).ravel())
            scale = ROBUST * (self._deviation or 1.0)
            root = (1 / (1 + (off / scale) ** 2)).astype(np.float32)  # square roots of the weights
            weighted = slopes * root[..., None]
            matrix[here] = weighted.transpose(0, 2, 1) @ weighted
            vector[here] = (weighted.transpose(0, 2, 1) @ (root * off)[..., None])[..., 0]
        every = np.concatenate(sampled) if sampled else np.zeros(0)
        self._deviation = 1.4826 * float(np.median(every)) + 1e-4 if len(every) else 1.0
        return _Equations(matrix, vector, self._deviation)

    def _placed(self, one: DepthView) -> Placed:
        correction = self._corrections[one.pose]
        given = self._rig.given[one.pose]
        return Placed(one, correction.camera(given), np.asarray(correction.shift), one.t + correction.time)

    def step(self, equations: _Equations, *, cameras: bool) -> None:
        """Change the planes, and the cameras if wanted, by a step of Gauss and Newton."""
        change, planes = self.solved(equations, np.ones(len(self.found.patch), bool), cameras=cameras)
        limit = LARGEST * self._planes[:, :1]
        self._planes += np.clip(planes, -limit, limit)
        wide = _wide(change)
        self._corrections = [one.plus(row) for one, row in zip(self._corrections, wide, strict=True)]

    def solved(
        self, equations: _Equations, pairs: np.ndarray, *, cameras: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of the cameras [K] and of the planes [P, 3] by some pairs [M]."""
        count, size = len(self._planes), len(self._units)
        patch, full = self.found.patch[pairs], equations.matrix[pairs]
        right = equations.vector[pairs]
        place = np.concatenate([self._places[0][pairs], self._places[1][pairs]], 1)
        own = np.r_[HOST, TARGET]
        shape, pull = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(shape, patch, full[:, SHAPE, SHAPE])
        np.add.at(pull, patch, right[:, SHAPE])
        both = np.zeros((count, size, 3))
        np.add.at(both, (patch[:, None], place), full[:, own, SHAPE])
        matrix, vector = np.zeros((size, size)), np.zeros(size)
        np.add.at(matrix, (place[:, :, None], place[:, None, :]), full[:, own][:, :, own])
        np.add.at(vector, place, right[:, own])
        trace = np.einsum("pii->p", shape)
        inverse = np.linalg.inv(shape + (1e-4 * trace + 1e-9)[:, None, None] * np.eye(3)) * (trace > 0)[:, None, None]
        step = np.zeros(size)
        if cameras:
            left = both @ inverse
            matrix -= np.tensordot(left, both, ((0, 2), (0, 2)))
            vector -= np.tensordot(left, pull, ((0, 2), (0, 1)))
            step = self._damped(matrix, vector, equations.deviation)
        planes = -(inverse @ (pull + np.tensordot(both, step, (1, 0)))[..., None])[..., 0]
        return step, planes

    def _damped(self, matrix: np.ndarray, vector: np.ndarray, deviation: float) -> np.ndarray:
        """Solve the normal equations of the cameras together with the prior. [K]"""
        noise = CORRELATED * deviation**2
        prior = np.resize([*[PRIOR_PX] * 6, PRIOR_SPACINGS], len(vector)) ** -2.0
        chosen = np.flatnonzero(np.arange(len(vector)) % EACH < self._columns)
        now = np.linalg.solve(self._units, self.total())
        left = self._units.T @ matrix @ self._units / noise + np.diag(prior)
        right = self._units.T @ vector / noise + prior * now
        step = np.zeros(len(vector))
        step[chosen] = -np.linalg.solve(left[np.ix_(chosen, chosen)], right[chosen])
        return self._units @ step


def _numbers(corrections: Sequence[Correction]) -> np.ndarray:
    """Return the poses and times of corrections. [K]"""
    return np.concatenate([[*one.rotvec, *one.shift, one.time] for one in corrections])


def _wide(numbers: np.ndarray) -> np.ndarray:
    """Return poses and times [K] in the order of `Correction.plus`. [R, COUNT]"""
    rows = np.zeros((len(numbers) // EACH, COUNT))
    rows[:, POSE], rows[:, TIME] = numbers.reshape(-1, EACH)[:, :6], numbers.reshape(-1, EACH)[:, 6:]
    return rows

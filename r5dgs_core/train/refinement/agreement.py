"""Evidence that cameras are wrong: corrections on which two sides of the pictures agree.

A wrong pose, focal length, clock or colour changes the whole picture in the same way. A scene that is not yet right
also leaves differences that corrections explain in part, but these are local: the left and the right half of the
pictures then need different corrections, and so do the upper and the lower half. So corrections are fitted to each side
alone. The product of both fits, averaged over the cameras, estimates the squared size of the true corrections; errors
of the two sides that are independent do not bias it. Both fits must also be more alike than independent ones usually
are, because few cameras agree on small corrections by chance.

Poses are examined alone, because sides of pictures hardly tell them from focal lengths. The other parts are fitted
together with poses, and must also reduce the error of the opposite side. Poses need not: one side determines some of
their axes so weakly that they do not fit the other side.

Notation: R poses, K tiles along each axis of an image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ...render import camera_fit
from ...render.camera_fit import Normal, Units
from ...scene.camera_correction import COLOR, FOCAL, POSE, TIME
from ...scene.cameras import Camera
from . import gauge
from .refinement import PARTS, POSES

RIDGE = 1e-3  # relative increase of the diagonal of the normal equations
CHANCE = 0.025  # probability that independent fits correlate enough to count as agreement
GREY = 0.5  # colour for which the size of a correction of colours is stated
_COLUMNS: dict[str, str] = dict(zip(PARTS, ("pose", "focal", "time", "color"), strict=True))

Sides = tuple[Normal, Normal]


@dataclass(frozen=True)
class Examined:
    """A pose of which some views were examined.

    Attributes:
        camera: Its camera as given, normalised coordinates.
        tiles: Normal equations of the tiles of its pictures, summed over the views. [K * K]
    """

    camera: Camera
    tiles: Sequence[Normal]

    def sides(self, part: str, units: Units) -> tuple[Sides, Sides]:
        """Return left and right, and upper and lower side, divided so that both determine a part equally well."""
        which = indices([part])
        steps = np.concatenate([units.steps(self.camera), np.ones(COLOR.stop - COLOR.start)])
        weight = np.array([tile.matrix[which, which] @ steps[which] ** 2 for tile in self.tiles])
        side = math.isqrt(len(self.tiles))
        square = weight.reshape(side, side)
        cols, rows = _first_side(square.sum(0)), _first_side(square.sum(1))
        number = np.arange(len(self.tiles))
        return self._divided(number % side < cols), self._divided(number // side < rows)

    def _divided(self, first: np.ndarray) -> Sides:
        a, b = ([t for t, here in zip(self.tiles, chosen, strict=True) if here] for chosen in (first, ~first))
        return camera_fit.added(a), camera_fit.added(b)


def _first_side(weights: np.ndarray) -> int:
    """Return the number of leading weights, at least one and not all, whose sum is closest to half of the total."""
    total = np.cumsum(weights)[:-1]
    return 1 + int(np.argmin(np.abs(total - 0.5 * weights.sum())))


def indices(parts: Sequence[str]) -> np.ndarray:
    """Return the indices of the parameters of some parts."""
    return camera_fit.columns(**{_COLUMNS[part]: True for part in parts})


@dataclass(frozen=True)
class Evidence:
    """Evidence for one part of the corrections.

    Attributes:
        size: Size on which the sides agree, 0 if they do not: px for poses and (at the border) focal lengths, intervals
            between the observed times for clocks, share of white for colours. It is 0 for other parts than poses if
            the gain is not positive.
        gain: Decrease of the error of each side by the part, with corrections fitted to the other side, dB.
    """

    size: float
    gain: float


def examine(
    poses: Sequence[Examined], parts: Sequence[str], units: Units, points: np.ndarray, spacing: float
) -> dict[str, Evidence]:
    """Return the evidence for each part.

    Args:
        poses: At least one pose.
        parts: From `PARTS`.
        units: Sizes of changes of a pixel.
        points: Points of the scene, for the units of the poses. [N, 3]
        spacing: Typical spacing of the observed times.
    """
    found = {}
    for part in parts:
        before = [POSES] if POSES in parts and part != POSES else []
        without, which = indices(before), indices([*before, part])
        cuts = list(zip(*(pose.sides(part, units) for pose in poses), strict=True))
        sizes = []
        for sides in cuts:
            first, second = (np.stack([side[k].solve(which, RIDGE) for side in sides]) for k in (0, 1))
            sizes.append(agreed(part, [pose.camera for pose in poses], first, second, points, spacing))
        every = [side for sides in cuts for side in sides]
        gain = 10 * math.log10(_error(every, without) / _error(every, which))
        found[part] = Evidence(min(sizes) if gain > 0 or part == POSES else 0.0, gain)
    return found


def _error(sides: Sequence[Sides], which: np.ndarray) -> float:
    """Return the squared error of each side with the corrections fitted to the other one."""
    total = 1e-12
    for a, b in sides:
        total += max(b.after(a.solve(which, RIDGE)), 0.0) + max(a.after(b.solve(which, RIDGE)), 0.0)
    return total


def agreed(
    part: str, poses: Sequence[Camera], first: np.ndarray, second: np.ndarray, points: np.ndarray, spacing: float
) -> float:
    """Return the size of a part in which two fits [R, COUNT] agree, rms over the poses; 0 if they do not agree."""
    a, b = (_in_units(part, poses, change, points, spacing) for change in (first, second))
    shared = float((a * b).sum())
    fixed = gauge.FREEDOM if part == POSES else a.size // len(a)  # a similarity, or the means over the cameras
    if shared < _least_correlation(a.size - fixed) * np.linalg.norm(a) * np.linalg.norm(b):
        return 0.0
    return math.sqrt(max(shared, 0.0) / len(a))


def _least_correlation(values: int) -> float:
    """Return the correlation that independent fits exceed with probability `CHANCE`.

    It is 2, which no fits reach, for fewer than two values: two numbers alone have a correlation of 1 or -1.

    Args:
        values: Number of values of a fit, less those that no image determines.
    """
    if values < 2:
        return 2.0
    t = float(stats.t.isf(CHANCE, values - 1))
    return t / math.hypot(t, math.sqrt(values - 1))


def _in_units(
    part: str, poses: Sequence[Camera], changes: np.ndarray, points: np.ndarray, spacing: float
) -> np.ndarray:
    """Return what corrections of a part change, in the units of `Evidence`, without what no image determines."""
    if part == POSES:
        units = np.stack([gauge.pixel_units(camera, points) for camera in poses])
        fixed = gauge.Gauge(poses, units).fix(changes[:, POSE])
        return np.linalg.solve(units, fixed[..., None])[..., 0]
    if part == "focal_lengths":
        values = changes[:, FOCAL] * np.array([[0.5 * camera.width] for camera in poses])
    elif part == "time_offsets":
        values = changes[:, TIME] / spacing
    else:
        gains, offsets = changes[:, COLOR][:, [0, 4, 8]], changes[:, COLOR][:, 9:]
        values = (GREY * gains + offsets) / math.sqrt(3)
    return values - values.mean(0)

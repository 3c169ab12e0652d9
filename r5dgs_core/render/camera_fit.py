"""Fit of a camera's correction to its images, for pictures drawn by any function.

The picture is linearised in the parameters of the correction (`camera_correction.Correction.plus`): pose, focal length
and time by differences of pictures, colours exactly. With residuals r and slopes J, the normal equations have the
matrix J^T J and the vector J^T r.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.camera_correction import COLOR, COUNT, FOCAL, POSE, TIME, Correction
from ..scene.cameras import Camera

Draw = Callable[[Camera, float], np.ndarray]  # picture of a camera at a scene time, [H, W, 3]

STEP = 0.25  # change of the picture for differences, px
TILES = 8  # number of parts along each axis of an image
ROWS = 1 << 16  # pixels per pass of the sums, which bounds memory
DAMPING, EASIER, HARDER = 1e-3, 0.3, 8.0  # of Levenberg and Marquardt
ITERATIONS, CONVERGED = 12, 1e-4  # maximum number of iterations; relative decrease of the error that ends them


@dataclass(frozen=True)
class Shot:
    """An image of a camera.

    Attributes:
        camera: The camera as given.
        t: Scene time as given.
        image: The image, in [0, 1]. [H, W, 3]
        valid: Pixels to compare; None for all. [H, W] bool
    """

    camera: Camera
    t: float
    image: np.ndarray
    valid: np.ndarray | None = None


@dataclass(frozen=True)
class Units:
    """Sizes of changes that move the picture by about a pixel.

    Attributes:
        depth: Typical depth of the scene, in the unit of the cameras' positions.
        time: Scene time.
    """

    depth: float
    time: float

    def steps(self, camera: Camera) -> np.ndarray:
        """Return the change of each parameter of the geometry that moves the picture by a pixel. [8]"""
        focal = float(camera.intrinsics[0, 0])
        return np.array([1 / focal] * 3 + [self.depth / focal] * 3 + [2 / camera.width, self.time])


@dataclass(frozen=True)
class Normal:
    """Normal equations of some pixels.

    Attributes:
        matrix: J^T J. [COUNT, COUNT]
        vector: J^T r. [COUNT]
        error: Sum of squared residuals.
        pixels: Number of pixels.
    """

    matrix: np.ndarray
    vector: np.ndarray
    error: float
    pixels: int

    def __add__(self, other: Normal) -> Normal:
        return Normal(
            self.matrix + other.matrix,
            self.vector + other.vector,
            self.error + other.error,
            self.pixels + other.pixels,
        )

    def solve(self, which: np.ndarray, damping: float = 1e-6) -> np.ndarray:
        """Return the change of the parameters ``which`` that minimises the linearised error, 0 for the others.

        Args:
            which: Indices of the parameters.
            damping: Increase of the diagonal, relative.
        """
        change = np.zeros(COUNT)
        if len(which):
            part = self.matrix[np.ix_(which, which)]
            scale = np.sqrt(np.maximum(np.diag(part), 1e-12))
            system = part / np.outer(scale, scale) + damping * np.eye(len(which))
            change[which] = np.linalg.solve(system, self.vector[which] / scale) / scale
        return change

    def after(self, change: np.ndarray) -> float:
        """Return the linearised error after a change of the parameters."""
        return float(self.error - 2 * self.vector @ change + change @ self.matrix @ change)


def added(parts: Sequence[Normal]) -> Normal:
    """Return the normal equations of all pixels of some parts, at least one."""
    return sum(parts[1:], parts[0])


def columns(pose: bool = False, focal: bool = False, time: bool = False, color: bool = False) -> np.ndarray:
    """Return the indices of the parameters of some parts of a correction.

    Of the gain, these are the diagonal entries only: grey scenes do not determine the others.
    """
    parts = ((pose, POSE), (focal, FOCAL), (time, TIME))
    indices = [np.arange(COUNT)[part] for wanted, part in parts if wanted]
    return np.concatenate([*indices, np.array([8, 12, 16, 17, 18, 19] if color else [], int)])


def normal_tiles(
    draw: Draw, shot: Shot, correction: Correction, units: Units, which: np.ndarray, tiles: int = TILES
) -> list[Normal]:
    """Return the normal equations of parts of an image, row by row. [tiles * tiles]

    Args:
        draw: Draws the scene.
        shot: The image.
        correction: Correction at which the picture is linearised.
        units: Sizes of changes of a pixel.
        which: Indices of the parameters whose slopes are needed; those of the geometry cost a picture each.
        tiles: Number of parts along each axis of the image.
    """
    plain = draw(correction.camera(shot.camera), shot.t + correction.time)
    picture = correction.seen(plain)
    steps = STEP * units.steps(shot.camera)
    geometry = []
    for index in (i for i in which if i < COLOR.start):
        change = np.zeros(COUNT)
        change[index] = steps[index]
        moved = correction.plus(change)
        other = moved.seen(draw(moved.camera(shot.camera), shot.t + moved.time))
        geometry.append((index, steps[index], (other - picture).reshape(-1, 3)))
    height, width = plain.shape[:2]
    rows, cols = np.arange(height) * tiles // height, np.arange(width) * tiles // width
    tile = (tiles * rows[:, None] + cols).astype(np.int16).ravel()
    if shot.valid is not None:
        tile[~shot.valid.ravel()] = -1
    colors, residual = plain.reshape(-1, 3), (shot.image - picture).reshape(-1, 3)
    tile[((shot.image >= 1) & (picture > 1)).any(-1).ravel()] = -1  # saturated
    order = np.argsort(tile, kind="stable")
    bounds = np.searchsorted(tile[order], np.arange(tiles * tiles + 1)).tolist()
    return [_sums(order[first:last], geometry, colors, residual) for first, last in itertools.pairwise(bounds)]


def _sums(
    pixels: np.ndarray, geometry: list[tuple[int, float, np.ndarray]], colors: np.ndarray, residual: np.ndarray
) -> Normal:
    """Return the normal equations of some pixels.

    Args:
        pixels: Their indices.
        geometry: Index and step of each parameter of the geometry, and the change of the picture by the step. [P, 3]
        colors: The picture without correction of its colours. [P, 3]
        residual: Image minus picture. [P, 3]
    """
    total = Normal(np.zeros((COUNT, COUNT)), np.zeros(COUNT), 0.0, 0)
    for first in range(0, len(pixels), ROWS):
        some = pixels[first : first + ROWS]
        slopes = np.zeros((len(some), 3, COUNT))
        for index, step, change in geometry:
            slopes[:, :, index] = change[some] / step
        for channel in range(3):
            slopes[:, channel, COLOR.start + 3 * channel : COLOR.start + 3 * channel + 3] = colors[some]
            slopes[:, channel, COLOR.stop - 3 + channel] = 1.0
        flat, left = slopes.reshape(-1, COUNT), residual[some].reshape(-1).astype(np.float64)
        total += Normal(flat.T @ flat, flat.T @ left, float(left @ left), len(some))
    return total


def fit(draw: Draw, shots: Sequence[Shot], units: Units, which: np.ndarray, start: Correction) -> Correction:
    """Return the correction of a camera that explains its images best, by Levenberg and Marquardt.

    Args:
        draw: Draws the scene.
        shots: Images of the camera.
        units: Sizes of changes of a pixel.
        which: Indices of the parameters to fit.
        start: First guess.
    """
    best, error, damping = start, _error(draw, shots, start), DAMPING
    for _ in range(ITERATIONS):
        normal = added([normal_tiles(draw, shot, best, units, which, tiles=1)[0] for shot in shots])
        before = error
        while damping < 1e6:
            tried = best.plus(normal.solve(which, damping))
            found = _error(draw, shots, tried)
            if found < error:
                best, error, damping = tried, found, damping * EASIER
                break
            damping *= HARDER
        if before - error <= CONVERGED * before:
            break
    return best


def _error(draw: Draw, shots: Sequence[Shot], correction: Correction) -> float:
    """Return the sum of squared errors of the pictures of a camera."""
    total = 0.0
    for shot in shots:
        picture = correction.seen(draw(correction.camera(shot.camera), shot.t + correction.time))
        squares = ((np.clip(picture, 0, 1) - shot.image) ** 2).sum(-1)
        total += float(squares.sum() if shot.valid is None else squares[shot.valid].sum())
    return total

"""Rotations of a ball from its texture, without a model of the texture that training has learned.

A track that turns too slowly as times enter is learned together with a texture that fits it, and gradients then remove
the error only slowly. Here the texture is eliminated: for given rotations, the logarithm of a colour is the sum of a
function on the ball, which turns with it, and of shade, a function of the direction in the world. Both are linear in
their coefficients, so the rotations alone are varied, by Gauss-Newton steps on what remains (variable projection). The
texture is coarse at first, so that rotations that are far off can be found, and then finer.

Notation: P pixels, S knots, N nodes of the texture, C = N + SHADES coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ..motion import rotations
from ..scene import spherical_harmonics
from ..shapes import directions as even_directions
from .ball_outlines import second_differences

COARSE, FINE = (40, 80), 160  # numbers of nodes, one after another
WIDTH = 8.0  # nodes per unit of the exponent of a node's bump: with N nodes, exp(N / WIDTH (cos a - 1))
RIDGE = 0.01  # weight of the squared coefficients of the texture, in pixels per node
SHADE_RIDGE = 0.1  # the same of the shade, relative to that of the texture
SMOOTH = 1e-3  # weight of squared second differences of the rotations, in pixels
DARKEST = 0.02  # smallest colour, because logarithms are compared
ROBUST = 3.0  # error in usual errors at which a pixel counts half
STEPS = 10  # largest number of steps with a texture
LARGEST = 0.35  # largest step, rad
ENOUGH = 2e-3  # relative gain of a step below which the steps end


@dataclass(frozen=True)
class SurfacePixels:
    """Pixels of a ball, in the order of their knots.

    Attributes:
        knots: Knot of each pixel, ascending. [P]
        directions: Unit direction from the centre to the surface there, world. [P, 3]
        colors: Colour of the image, in [0, 1]. [P, 3]
    """

    knots: np.ndarray
    directions: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class Alignment:
    """Rotations at which one texture explains the images.

    Attributes:
        quats: Rotations, unit wxyz. [S, 4]
        error: Squared error with them.
        before: The same with the given rotations, in the frame of these.
        plain: The same with shade alone.
        texture: Coefficients of the texture. [N, 3]
        mean: Mean logarithm of the colours. [3]
    """

    quats: np.ndarray
    error: float
    before: float
    plain: float
    texture: np.ndarray
    mean: np.ndarray

    def colors(self, directions: np.ndarray) -> np.ndarray:
        """Colours of the texture in usual light, at unit directions in the ball. [P, 3] -> [P, 3]"""
        return np.clip(np.exp(_bumps(directions, len(self.texture)) @ self.texture + self.mean), 0, 1)


def align(pixels: SurfacePixels, quats: np.ndarray, times: np.ndarray) -> Alignment:
    """Find the rotations at which one texture explains the images.

    Args:
        pixels: The pixels.
        quats: Rotations to start from, unit wxyz. [S, 4]
        times: Knots. [S]
    """
    given = quats
    for count in COARSE:
        quats = _Fit(pixels, count, quats, times).aligned(quats)
    fit = _Fit(pixels, FINE, quats, times)
    quats = fit.aligned(quats)
    found, before = fit.at(quats), fit.at(in_frame_of(given, quats))
    return Alignment(quats, found.squares, before.squares, fit.plain, found.coefficients[:FINE], fit.mean)


def in_frame_of(quats: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return rotations in the frame of the ball in which they are nearest to others. [S, 4]

    The frame is arbitrary, but a texture of few nodes is not exactly the same in all of them.
    """
    off = rotations.multiply(rotations.conjugate(quats), others)
    off = off * np.where(off @ off[len(off) // 2] < 0, -1.0, 1.0)[:, None]
    return rotations.normalize(rotations.multiply(quats, rotations.normalize(off.mean(0))))


def _bumps(directions: np.ndarray, count: int) -> np.ndarray:
    """Values of the nodes' functions at directions in the ball. [P, 3] -> [P, N]"""
    return np.exp(count / WIDTH * (directions @ even_directions.sphere(count).T - 1))


def _shade(directions: np.ndarray) -> np.ndarray:
    """Harmonics of degree 1 to 3 of directions in the world. [P, 3] -> [P, SHADES]"""
    return spherical_harmonics.basis(directions, 3)[:, 1:]


@dataclass(frozen=True)
class _State:
    """Texture and shade that fit best at some rotations.

    Attributes:
        bumps: Values of the nodes' functions. [P, N]
        columns: All functions, weighted. [P, C]
        factor: Cholesky factor of their normal matrix.
        coefficients: Coefficients. [C, 3]
        left: Weighted errors. [P, 3]
        squares: Their squared sum, with the ridge.
        total: The same, with the roughness of the rotations.
    """

    bumps: np.ndarray
    columns: np.ndarray
    factor: tuple[np.ndarray, bool]
    coefficients: np.ndarray
    left: np.ndarray
    squares: float
    total: float


class _Fit:
    """Fits with a texture of some number of nodes.

    Args:
        pixels: The pixels.
        count: Number of nodes.
        quats: Rotations that determine the weights of the pixels.
        times: Knots.
    """

    def __init__(self, pixels: SurfacePixels, count: int, quats: np.ndarray, times: np.ndarray):
        self._pixels, self._count = pixels, count
        self._nodes, self._shade = even_directions.sphere(count), _shade(pixels.directions)
        self._bend, self._steps = second_differences(times), np.diff(times) / np.diff(times).mean()
        bounds = np.searchsorted(pixels.knots, np.arange(len(times) + 1))
        self._rows: Sequence[slice] = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
        shades = self._shade.shape[1]
        weights = np.concatenate([np.ones(count), np.full(shades, SHADE_RIDGE)])
        self._ridge = RIDGE * len(pixels.knots) / count * weights
        self._smooth = SMOOTH * len(pixels.knots)
        colors = np.maximum(pixels.colors, DARKEST)
        bright = colors.mean(1)  # an error of the logarithm is one of the colour, divided by it
        self._log, self._weights = np.log(colors), bright / np.sqrt((bright**2).mean())
        far = (self.at(quats).left ** 2).sum(1) / self._weights**2
        self._weights = self._weights / np.sqrt(1 + far / (ROBUST**2 * max(float(np.median(far)), 1e-12)))
        self.mean = (self._weights[:, None] * self._log).sum(0) / self._weights.sum()
        wanted = self._weights[:, None] * (self._log - self.mean)
        light = self._weights[:, None] * self._shade
        shade = np.linalg.lstsq(light, wanted, rcond=1e-6)[0]
        self.plain = float(((light @ shade - wanted) ** 2).sum())

    def at(self, quats: np.ndarray) -> _State:
        """Return the best texture and shade at rotations."""
        turned = rotations.rotate(rotations.conjugate(quats)[self._pixels.knots], self._pixels.directions)
        bumps = _bumps(turned, self._count)
        columns = self._weights[:, None] * np.concatenate([bumps, self._shade], axis=1)
        mean = (self._weights[:, None] * self._log).sum(0) / self._weights.sum()
        wanted = self._weights[:, None] * (self._log - mean)
        factor = linalg.cho_factor(columns.T @ columns + np.diag(self._ridge))
        found = linalg.cho_solve(factor, columns.T @ wanted)
        left = columns @ found - wanted
        squares = float((left**2).sum() + (self._ridge[:, None] * found**2).sum())
        total = squares + self._smooth * float((self._rough(quats) ** 2).sum())
        return _State(bumps, columns, factor, found, left, squares, total)

    def _rough(self, quats: np.ndarray) -> np.ndarray:
        """Second differences of the rotations. [S - 2, 3]"""
        turns = rotations.quats_to_rotvecs(rotations.multiply(quats[1:], rotations.conjugate(quats[:-1])))
        rates = turns / self._steps[:, None]
        return 2 * np.diff(rates, axis=0) / (self._steps[1:] + self._steps[:-1])[:, None]

    def aligned(self, quats: np.ndarray) -> np.ndarray:
        """Return the rotations near given ones [S, 4] at which the error is least."""
        state, damping = self.at(quats), 1e-3
        for _ in range(STEPS):
            normal, slope = self._normal(state, quats)
            diagonal = np.diag(np.diag(normal)) * damping + 1e-9 * np.trace(normal) * np.eye(len(normal))
            change = -np.linalg.solve(normal + diagonal, slope).reshape(-1, 3)
            change *= min(1.0, LARGEST / max(float(np.abs(change).max()), 1e-12))
            turned = rotations.normalize(rotations.multiply(rotations.rotvecs_to_quats(change), quats))
            new = self.at(turned)
            gain = 1 - new.total / state.total
            if gain <= 0:
                damping *= 30
                if damping > 1e3:
                    break
                continue
            quats, state, damping = turned, new, max(0.3 * damping, 1e-6)
            if gain < ENOUGH:
                break
        return quats

    def _normal(self, state: _State, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and gradient of half of the error by turns of the knots, world. [3 S, 3 S], [3 S]"""
        size = 3 * len(quats)
        bend = np.kron(self._bend, np.eye(3))
        normal = self._smooth * bend.T @ bend
        slope = self._smooth * bend.T @ self._rough(quats).ravel()
        knots, directions = self._pixels.knots, self._pixels.directions
        for channel in range(3):
            rises = self._count / WIDTH * (state.bumps * state.coefficients[: self._count, channel]) @ self._nodes
            # A turn w of the ball moves the direction d in the ball by -w x d, seen from the world.
            turns = self._weights[:, None] * np.cross(rotations.rotate(quats[knots], rises), directions)
            mixed = np.zeros((state.columns.shape[1], size))
            for s, rows in enumerate(self._rows):
                here, own = slice(3 * s, 3 * s + 3), turns[rows]
                mixed[:, here] = state.columns[rows].T @ own
                normal[here, here] += own.T @ own
                slope[here] += own.T @ state.left[rows, channel]
            normal -= mixed.T @ linalg.cho_solve(state.factor, mixed)
        return normal, slope

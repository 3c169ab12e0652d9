"""Rotations of a body that its images cannot show: of a plain ball about all axes, of a plain vase about its own.

Two conditions must hold for an axis of the body. It is round about the axis: the second moments of its outlines in all
views fit an ellipsoid with two equal axes, or with three. And it has no texture: its image is a smooth function of the
direction from its centre (shade, which stays where the light is when the body turns), plus, for a vase, a function of
the height along the axis. The share of the contrast that these do not explain is measured for each time separately.
Slopes of the pixels alone would not do: the shade of a trained body is partly baked into its colours, which turn with
it.

Notation: P pixels inside the outline, V views, K unseen axes (1 or 3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..motion import rotations

TEXTURE = 0.22  # share of the contrast above which a texture is seen; 0.14 for plain balls, 0.33 and more with texture
ROUND = 0.92  # smallest ratio of two axes of the ellipsoid that count as equal
ROUNDS = 15  # number of fits with new weights
LIGHT = 4  # number of polynomials for the brightness and the direction of the light at a time: constant, x, y, z
HEIGHTS = 20  # number of heights along an axis between which colours are interpolated
DARKEST = 0.02  # smallest colour, because shade is fitted to logarithms
MIN_PIXELS_PER_COEFFICIENT = 3  # minimum number of pixels per coefficient of a fit


@dataclass(frozen=True)
class Surface:
    """A body at a knot, from all views.

    Attributes:
        directions: Unit directions from the centre to the surface, world. [P, 3]
        colors: Colours of the image there. [P, 3]
        planes: Two orthogonal unit vectors of each view, perpendicular to the direction of the body, world. [V, 2, 3]
        moments: Second moments of the outline along them, world units. [V, 2, 2]
        turn: Rotation of the body, unit wxyz. [4]
    """

    directions: np.ndarray
    colors: np.ndarray
    planes: np.ndarray
    moments: np.ndarray
    turn: np.ndarray


@dataclass(frozen=True)
class Unseen:
    """Axes about which rotations are not seen.

    Attributes:
        axes: Unit axes in the frame of the body, at t_max; all three if no rotation is seen. [K, 3]
        texture: Share of the contrast that shade does not explain.
    """

    axes: np.ndarray
    texture: float

    def text(self) -> str:
        """Axes in words, for the needs table."""
        if len(self.axes) == 3:
            return "rotation about any axis: cannot be seen"
        return "rotation about its axis ({:.2f}, {:.2f}, {:.2f}): cannot be seen".format(*self.axes[0])


def find(surfaces: Sequence[Surface]) -> Unseen | None:
    """Return the axes about which no rotation of a body is seen; None if all rotations are seen.

    Args:
        surfaces: The body at the knots that show it.
    """
    if not surfaces:
        return None
    found = _ellipsoid(surfaces)
    if found is None:
        return None
    lengths, axes = found  # ascending
    if lengths[0] >= ROUND * lengths[2]:
        texture = texture_share(surfaces, None)
        return Unseen(np.eye(3), texture) if texture <= TEXTURE else None
    pairs = lengths[:2] / lengths[1:]
    axis = axes[:, 2 if pairs[0] > pairs[1] else 0]
    if pairs.max() < ROUND:
        return None
    texture = texture_share(surfaces, axis)
    return Unseen(axis[None], texture) if texture <= TEXTURE else None


def _ellipsoid(surfaces: Sequence[Surface]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the axes of the ellipsoid with the outlines of a body: lengths, ascending [3], and directions, columns.

    The outline of an ellipsoid with the second moments A has those of A in the plane of the view. None if the outlines
    do not determine it.
    """
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        basis[k, i, j] = basis[k, j, i] = 1.0
    views = np.concatenate([s.planes @ rotations.quats_to_rotmats(s.turn) for s in surfaces])  # axes of the body
    columns = np.einsum("vai,kij,vbj->vabk", views, basis, views)
    moments = np.concatenate([surface.moments for surface in surfaces])
    weights, fit = np.ones(len(moments)), np.zeros(6)
    for _ in range(ROUNDS):  # least absolute errors, because other objects and image borders cut some outlines
        root = np.sqrt(weights)[:, None, None]
        fit, _, rank, _ = np.linalg.lstsq(
            (columns * root[..., None]).reshape(-1, 6), (moments * root).ravel(), rcond=1e-6
        )
        if rank < 6:
            return None
        left = np.linalg.norm(columns @ fit - moments, axis=(1, 2))
        weights = 1 / np.maximum(left, 1e-3 * np.median(np.linalg.norm(moments, axis=(1, 2))))
    values, axes = np.linalg.eigh(np.einsum("k,kij->ij", fit, basis))
    return np.sqrt(np.maximum(values, 0.0)), axes


def texture_share(surfaces: Sequence[Surface], axis: np.ndarray | None) -> float:
    """Return the share of the contrast that shade, and colours by the height along an axis, do not explain.

    Shade is one smooth function of the direction at all times, but the brightness of the light and its direction may
    change with the place. Coarse texture is smooth as well; it turns with the body, so no such function fits all times.
    """
    rest, contrast = 0.0, 0.0
    parts = [_columns(surface, axis) for surface in surfaces]
    parts = [part for part in parts if len(part[0]) >= MIN_PIXELS_PER_COEFFICIENT * (LIGHT + part[2].shape[1])]
    for channel in range(3):
        common, wanted = [], []
        for colors, light, shade in parts:
            # The weights make the errors those of the colours themselves, and all times count the same.
            weights = colors[:, channel, None] / math.sqrt(len(colors))
            both = weights * np.concatenate([shade, np.log(colors[:, channel, None])], axis=1)
            both -= weights * light @ np.linalg.lstsq(weights * light, both, rcond=1e-6)[0]
            common.append(both[:, :-1])
            wanted.append(both[:, -1])
            contrast += float(colors[:, channel].var())
        if parts:
            columns, target = np.concatenate(common), np.concatenate(wanted)
            fit = np.linalg.lstsq(columns, target, rcond=1e-6)[0]
            rest += float(((columns @ fit - target) ** 2).sum())
    return math.sqrt(rest / contrast) if contrast > 0 else 1.0


def _columns(surface: Surface, axis: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours [P, 3], and the functions that fit a time alone [P, LIGHT] and all times together. [P, K]"""
    smooth = _smooth(surface.directions)
    light, shade = smooth[:, :LIGHT], smooth[:, LIGHT:]
    if axis is not None:
        heights = surface.directions @ rotations.rotate(surface.turn, axis)
        shade = np.concatenate([shade, _interpolation(heights)], axis=1)
    return np.maximum(surface.colors, DARKEST), light, shade


def _smooth(d: np.ndarray) -> np.ndarray:
    """Return polynomials of degree 3 of unit directions. [P, 3] -> [P, 16]"""
    x, y, z = np.moveaxis(d, -1, 0)
    squares = [x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
    cubes = [x * y * z, z * (x * x - y * y), x * (x * x - 3 * y * y), y * (3 * x * x - y * y)]
    cubes += [x * (5 * z * z - 1), y * (5 * z * z - 1), z * (5 * z * z - 3)]
    return np.stack([np.ones_like(x), x, y, z, *squares, *cubes], axis=-1)


def _interpolation(heights: np.ndarray) -> np.ndarray:
    """Return the weights of linear interpolation between values at `HEIGHTS` heights from -1 to 1. [P, HEIGHTS]"""
    nodes = np.linspace(-1, 1, HEIGHTS)
    return np.maximum(0.0, 1 - np.abs(heights[:, None] - nodes) / (nodes[1] - nodes[0]))

"""Numerical inverse of a view transform: scene-linear colours that are displayed as given colours.

A view transform (AgX, Filmic, with a look, an exposure, curves) is known here only as a function ``forward`` that maps
scene-linear to display colours. Its inverse is a table in two steps. One curve per channel, the inverse along greys,
leaves a map that is nearly the identity; a grid stores that map, solved at each node by damped Newton steps on
``forward``. Codes are asinh(colour / KNEE): linear around black, logarithmic for bright colours, and defined for the
negative values of colours outside the scene's gamut.

Display colours out of reach of the view are mapped to the nearest displayable ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

Forward = Callable[[np.ndarray], np.ndarray]  # scene linear [N, 3] to display, in [0, 1] [N, 3]

KNEE = 0.05  # scene-linear colour at which codes turn from linear to logarithmic
BRIGHTEST = 16.3  # scene-linear colour that most view transforms display as white, 6.5 stops above mid-grey
MAX_WHITE = 16.0  # white of the softest looks, in multiples of BRIGHTEST
SIZE = 33  # grid nodes per channel
STEP = 1 / 255  # 8-bit display step, the unit of errors
VISIBLE = 1.5 * STEP  # minimum visible error
SOLVED = 0.5 * STEP  # maximum error of a node within the view's reach

_CODES = 65536  # entries per curve, far finer than the precision of image files
_CHUNK = 65536  # colours per block, sized for the CPU cache


@dataclass(frozen=True, eq=False)
class Inverse:
    """Inverse of a view transform. Compared by identity.

    Attributes:
        curves: Grid position, in nodes, of each display colour. [3, 65536] float32
        grid: Codes of the scene-linear colours at the nodes. [SIZE, SIZE, SIZE, 3] float32
        scale: Factor on decoded colours.
        error: 95th percentile of the error of colours within reach, in steps of 1/255.
        reach: Fraction of the grid's nodes, from greys to the most saturated, that the view can display.
    """

    curves: np.ndarray
    grid: np.ndarray
    scale: float
    error: float
    reach: float

    def scene_linear(self, display: np.ndarray) -> np.ndarray:
        """Scene-linear colours whose display equals the given colours, or the nearest displayable ones.

        Args:
            display: Display colours, clamped to [0, 1] here. [..., 3]

        Returns:
            Scene-linear colours, negative outside the gamut of the scene's colour space. [..., 3] float32
        """
        flat = display.reshape(-1, 3)
        result = np.empty(flat.shape, np.float32)
        for start in range(0, len(flat), _CHUNK):
            part = slice(start, start + _CHUNK)
            result[part] = self.scale * _decode(_interpolate(self.grid, self._places(flat[part])))
        return result.reshape(display.shape)

    def _places(self, display: np.ndarray) -> np.ndarray:
        """Grid positions of display colours, in nodes. [N, 3]"""
        index = (np.clip(display, 0, 1) * (_CODES - 1) + 0.5).astype(np.intp)
        return np.stack([curve[index[:, channel]] for channel, curve in enumerate(self.curves)], axis=-1)


@dataclass(frozen=True)
class Loss:
    """Error of display colours after inverting and reapplying a view transform.

    Attributes:
        psnr: PSNR in dB, including rounding to 8 bits; at most 59.
        unreached: Fraction of the colours with an error above `VISIBLE`.
    """

    psnr: float
    unreached: float


def loss(forward: Forward, made: Inverse, display: np.ndarray, weights: np.ndarray) -> Loss:
    """Measure the error of display colours under an inverted view transform.

    Args:
        forward: Maps scene-linear to display colours.
        made: Its inverse.
        display: The target colours. [N, 3]
        weights: Weight of each colour. [N]
    """
    wanted = np.asarray(display, np.float64)
    off = np.asarray(forward(made.scene_linear(wanted)), np.float64) - wanted
    squared = np.average(np.square(off).mean(axis=-1), weights=weights) + STEP**2 / 12  # variance of rounding
    return Loss(-10 * float(np.log10(squared)), float(np.average(np.abs(off).max(axis=-1) > VISIBLE, weights=weights)))


def invert(forward: Forward, scale: float = 1.0) -> Inverse:
    """Compute the inverse of a view transform.

    Args:
        forward: Maps scene-linear to display colours; called a few dozen times with up to 110,000 colours.
        scale: Factor on the colours, 2 ** -exposure, such that ``forward(scale * BRIGHTEST)`` is about white; up to
            `MAX_WHITE` times as bright is allowed.
    """

    def shown(codes: np.ndarray) -> np.ndarray:
        return np.asarray(forward(scale * _decode(codes)), np.float64)

    top = _top(shown)
    greys = np.linspace(0, top, 2048)
    # In flat parts of a curve, use the darkest of the equally displayed colours.
    rising = np.maximum.accumulate(shown(np.repeat(greys[:, None], 3, axis=1)), axis=0)
    axis = np.linspace(0, top, SIZE)
    axes = [np.interp(axis, greys, rising[:, channel]) for channel in range(3)]
    wanted = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    start = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    codes, found = _solve(shown, wanted, start, top, rounds=5)
    codes, found = _retry(shown, wanted, codes, found, top, rounds=3)
    solved = _far(found, wanted) < SOLVED
    grid = _continue(codes.reshape(SIZE, SIZE, SIZE, 3), solved, top)
    display = np.linspace(0, 1, _CODES)
    tiny = 1e-9 * np.arange(len(greys))  # np.interp requires increasing values
    curves = [np.interp(display, rising[:, channel] + tiny, greys) for channel in range(3)]
    curves = (np.stack(curves) / top * (SIZE - 1)).astype(np.float32)
    made = Inverse(curves, grid.astype(np.float32), scale, 0.0, float(solved.mean()))
    return replace(made, error=_error(forward, made))


def _top(shown: Forward) -> float:
    """Code of white: the smallest grey code at or above `BRIGHTEST` that displays like the brightest tested one."""
    tried = np.arcsinh(BRIGHTEST * np.geomspace(1.0, MAX_WHITE, 17) / KNEE)
    white = shown(np.repeat(tried[:, None], 3, axis=1))
    return float(tried[np.argmax(_far(white, white[-1]) < SOLVED)])


def _decode(codes: np.ndarray) -> np.ndarray:
    return KNEE * np.sinh(codes)


def _far(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Largest difference of colours over the channels. [N]"""
    return np.abs(found - wanted).max(axis=-1)


def _squared(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Squared difference of colours. [...]"""
    off = found - wanted
    return np.einsum("...k,...k->...", off, off)  # faster than sum over an axis of length three


def _solve(
    shown: Forward, wanted: np.ndarray, codes: np.ndarray, top: float, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find codes with given display colours, by Levenberg-Marquardt steps with finite differences.

    Args:
        shown: Maps codes to display colours.
        wanted: Target display colours. [N, 3]
        codes: Initial guess. [N, 3]
        top: Largest code; -top is the smallest.
        rounds: Number of steps; each evaluates four colours per unsolved one.

    Returns:
        Codes, and their display colours. [N, 3] each
    """
    codes, found, delta = codes.copy(), shown(codes), 0.01
    damping = np.full(len(codes), 1e-4)
    for _ in range(rounds):
        rows = np.flatnonzero((_far(found, wanted) > SOLVED / 2) & (damping < 10))
        if not len(rows):
            break
        here, miss = codes[rows], found[rows] - wanted[rows]
        ahead = np.where(here > top - delta, -delta, delta)
        moved = here + ahead.T[:, :, None] * np.eye(3)[:, None, :]
        shifted = shown(moved.reshape(-1, 3)).reshape(moved.shape) - found[rows]
        jacobian = np.moveaxis(shifted / ahead.T[:, :, None], 0, -1)
        normal = np.einsum("nki,nkj->nij", jacobian, jacobian) + damping[rows, None, None] * np.eye(3)
        step = np.linalg.solve(normal, -np.einsum("nki,nk->ni", jacobian, miss)[..., None])[..., 0]
        there = np.clip(here + np.clip(step, -1, 1), -top, top)
        then = shown(there)
        better = _squared(then, wanted[rows]) < _squared(found[rows], wanted[rows])
        codes[rows[better]], found[rows[better]] = there[better], then[better]
        damping[rows] = np.where(better, np.maximum(0.1 * damping[rows], 1e-9), 10 * damping[rows])
    return codes, found


def _retry(
    shown: Forward, wanted: np.ndarray, codes: np.ndarray, found: np.ndarray, top: float, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the unsolved nodes again, each from the solved node displayed nearest to its target."""
    solved = _far(found, wanted) < SOLVED
    shape = (SIZE, SIZE, SIZE)
    nearest = np.where(solved, np.arange(len(codes)), -1).reshape(shape)
    goal = wanted.reshape(*shape, 3)
    gap = np.where(solved.reshape(shape), _squared(found, wanted).reshape(shape), np.inf)
    for _ in range(SIZE):  # flood fill from node to node
        changed = False
        for into, out_of in _neighbours():
            candidate = nearest[out_of]
            distance = np.where(candidate >= 0, _squared(found[candidate], goal[into]), np.inf)
            closer = distance < gap[into]
            changed |= bool(closer.any())
            nearest[into] = np.where(closer, candidate, nearest[into])
            gap[into] = np.where(closer, distance, gap[into])
        if not changed:
            break
    rows = np.flatnonzero(gap.ravel() < _squared(found, wanted))
    codes, found = codes.copy(), found.copy()
    if len(rows):
        codes[rows], found[rows] = _solve(shown, wanted[rows], codes[nearest.ravel()[rows]], top, rounds)
    return codes, found


def _neighbours() -> Iterator[tuple[tuple[slice, ...], tuple[slice, ...]]]:
    """Pairs of slices of a grid, shifted by one node along each axis in both directions."""
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        yield tuple(low), tuple(high)
        yield tuple(high), tuple(low)


def _continue(grid: np.ndarray, solved: np.ndarray, top: float) -> np.ndarray:
    """Extrapolate the grid linearly by one node past the view's reach, so that border cells interpolate correctly.

    Args:
        grid: Codes. [SIZE, SIZE, SIZE, 3]
        solved: True for nodes within the view's reach. [SIZE ** 3]
        top: Largest code.

    Returns:
        Codes. [SIZE, SIZE, SIZE, 3]
    """
    solved = solved.reshape(grid.shape[:3])
    total, count = np.zeros_like(grid), np.zeros(grid.shape[:3])
    for axis in range(3):
        for order in (slice(None), slice(None, None, -1)):
            flip = tuple(order if other == axis else slice(None) for other in range(3))
            codes, fine = np.moveaxis(grid[flip], axis, 0), np.moveaxis(solved[flip], axis, 0)
            into, number = np.moveaxis(total[flip], axis, 0), np.moveaxis(count[flip], axis, 0)
            both = fine[:-2] & fine[1:-1]
            into[2:] += np.where(both[..., None], 2 * codes[1:-1] - codes[:-2], 0)
            number[2:] += both
    edge = ~solved & (count > 0)
    result = grid.copy()
    result[edge] = np.clip(total[edge] / count[edge][:, None], -top, top)
    return result


def _interpolate(grid: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Trilinear interpolation of a grid at positions in nodes. [N, 3]"""
    size = grid.shape[0]
    low = np.minimum(places.astype(np.intp), size - 2)
    part = places - low
    weights = (1 - part, part)
    rows, base = grid.reshape(-1, 3), (low[:, 0] * size + low[:, 1]) * size + low[:, 2]
    result = np.zeros((len(places), 3), np.float32)
    for corner in range(8):
        i, j, k = corner >> 2, corner >> 1 & 1, corner & 1
        weight = weights[i][:, 0] * weights[j][:, 1] * weights[k][:, 2]
        result += weight[:, None] * rows.take(base + ((i * size + j) * size + k), axis=0)
    return result


def _error(forward: Forward, made: Inverse) -> float:
    """95th percentile of the round-trip error of displayable colours of non-negative light, in steps of 1/255."""
    random = np.random.default_rng(0)
    light = 2.0 ** random.uniform(-6, 2, (4000, 1)) * 2.0 ** random.uniform(-0.7, 0.7, (4000, 3))
    wanted = np.asarray(forward(made.scale * light), np.float64)
    again = np.asarray(forward(made.scene_linear(wanted)), np.float64)
    return float(np.percentile(_far(again, wanted), 95)) / STEP

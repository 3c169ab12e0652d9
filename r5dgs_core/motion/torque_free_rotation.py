"""Torque-free rotation of a rigid body (free asymmetric top), such as a thrown box that tumbles.

Notation: J inertia in the world at tau = 0, up to a factor; I1, I2, I3 its principal moments; A the rotation from the
principal axes to the world; w_k spins about the principal axes; L = |J w| and 2E = w J w, both conserved. The axes are
ordered so that the angular velocity circles the third one. With u = p tau + u_0, Euler's equations give w_1 =
w_1m cn u, w_2 = w_2m sn u, w_3 = w_3m dn u, Jacobi's elliptic functions of parameter m. About the fixed vector J w, a
body axis k precesses at the rate L (2E - I_k w_k^2) / (L^2 - I_k^2 w_k^2), whose integral is a mean rate plus a Fourier
series. The solution is in closed form, so any time costs the same.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields

import numpy as np

from . import rotations

DISTINCT = 0.1  # minimum relative difference of moments for a visible tumble
LINE = 1e-3  # minimum ratio of the smallest to the largest moment; collinear bodies are below it
_GAP = 1e-9  # minimum relative gap between moments; Euler's solution divides by their differences
_SAMPLES = 256  # per period; the Fourier series converges like exp(-n), more slowly near a separatrix
_TINY = 1e-300
_FASTEST = 1e150  # rad per unit of time
_MIN_M1 = 1e-20  # keeps spins off the separatrix, where the period is infinite


def inertia(points: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Inertia of a point cloud about its centroid, scaled to trace 1; that of a ball if the cloud has no extent.

    Args:
        points: Positions in the world. [n, 3]
        weights: Masses, >= 0, or None for equal ones. [n]

    Returns:
        Symmetric, positive semidefinite. [3, 3]
    """
    points = np.asarray(points, np.float64)
    masses = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    if len(points) == 0 or not masses.sum() > 0:
        return np.eye(3) / 3
    offsets = points - np.average(points, axis=0, weights=masses)
    spread = np.einsum("n,ni,nj->ij", masses, offsets, offsets)
    size = float(np.trace(spread))
    return (np.eye(3) * size - spread) / (2 * size) if size > 0 else np.eye(3) / 3


def tumbles(body: np.ndarray) -> bool:
    """Return True if a body with this inertia tumbles visibly: it is neither nearly a ball nor a line. [3, 3]"""
    moments = np.linalg.eigvalsh(body)
    return bool(LINE * moments[2] < moments[0] < (1 - DISTINCT) * moments[2])


def rotations_and_spins(body: np.ndarray, w: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and angular velocities of a free body.

    Args:
        body: Inertia J in the world at tau = 0, symmetric with positive moments. [3, 3]
        w: Angular velocity at tau = 0, world frame, rad per unit of time. [..., 3]
        tau: Times of either sign. [S]

    Returns:
        Rotations since tau = 0, unit wxyz with w >= 0 [..., S, 4], exactly the identity at tau = 0; angular velocities
        in the world frame [..., S, 3].

    Source: Euler's equations; Jacobi's solution by arithmetic-geometric means.
    """
    w, tau = np.asarray(w, np.float64), np.asarray(tau, np.float64)
    path = _solve(body, w)
    frames, spins = path.at(np.concatenate([np.zeros(1), tau]))
    axes = path.axes[..., None, :, :]
    to_world = axes @ np.swapaxes(frames[..., :1, :, :], -1, -2) @ frames[..., 1:, :, :]
    quats = rotations.rotmats_to_quats(to_world @ np.swapaxes(axes, -1, -2))
    still = (tau == 0)[..., None] | (w == 0).all(-1)[..., None, None]
    return np.where(still, rotations.identity(), quats), (to_world @ spins[..., 1:, :, None])[..., 0]


class Tops:
    """Several free bodies, evaluated together. Time-independent quantities are precomputed.

    Args:
        bodies: Inertia of each in the world at tau = 0. [K, 3, 3]
        w: Angular velocities at tau = 0, world frame. [K, 3]
    """

    def __init__(self, bodies: np.ndarray, w: np.ndarray):
        paths = [_solve(body, spin) for body, spin in zip(bodies, w, strict=True)]
        names = [field.name for field in fields(_Path)]
        self._path = _Path(**{name: np.stack([getattr(path, name) for path in paths]) for name in names})
        self._still = (np.asarray(w) == 0).all(-1)
        frames, _ = self._path.at(np.zeros(1))
        self._from_start = self._path.axes @ np.swapaxes(frames[:, 0], -1, -2)

    def turns(self, tau: float) -> np.ndarray:
        """Rotations since tau = 0, as from `rotations_and_spins`. [K, 4]"""
        frames, _ = self._path.at(np.array([tau], np.float64))
        quats = rotations.rotmats_to_quats(self._from_start @ frames[:, 0] @ np.swapaxes(self._path.axes, -1, -2))
        return np.where((self._still | (tau == 0))[:, None], rotations.identity(), quats)


@dataclass(frozen=True)
class _Path:
    """Elliptic-function solution for B spins, with principal axes in Jacobi's order.

    Attributes:
        axes: Columns are the principal axes in the world at tau = 0. [B, 3, 3]
        moments: Principal moments. [B, 3]
        peaks: w_1m, w_2m, w_3m with their signs. [B, 3]
        rate: p. [B]
        phase: u_0. [B]
        m1: 1 - m. [B]
        pole: Index of the axis k whose precession is integrated, the one farther from the fixed vector. [B]
    """

    axes: np.ndarray
    moments: np.ndarray
    peaks: np.ndarray
    rate: np.ndarray
    phase: np.ndarray
    m1: np.ndarray
    pole: np.ndarray

    def spins(self, u: np.ndarray) -> np.ndarray:
        """Angular velocities about the principal axes. [B, S] -> [B, S, 3]"""
        sn, cn, dn = jacobi_elliptic(u, self.m1[..., None])
        return np.stack([cn, sn, dn], -1) * self.peaks[..., None, :]

    def precession(self, spins: np.ndarray) -> np.ndarray:
        """Precession rate of axis `pole` about the fixed vector. [B, S, 3] -> [B, S]"""
        momenta = self.moments[..., None, :] * spins
        squares, energies = momenta**2, momenta * spins
        k = np.broadcast_to(self.pole[..., None, None], (*spins.shape[:-1], 1))
        length = squares.sum(-1)
        across = length - np.take_along_axis(squares, k, -1)[..., 0]
        energy = energies.sum(-1) - np.take_along_axis(energies, k, -1)[..., 0]
        return np.sqrt(length) * energy / np.maximum(across, _TINY)

    def at(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations from the principal axes to a world-fixed frame [B, S, 3, 3] and spins [B, S, 3]."""
        u = self.rate[..., None] * tau + self.phase[..., None]
        spins = self.spins(u)
        momenta = self.moments[..., None, :] * spins
        up = momenta / np.maximum(np.linalg.norm(momenta, axis=-1, keepdims=True), _TINY)
        poles = np.eye(3)[self.pole][..., None, :]
        east = poles - (poles * up).sum(-1)[..., None] * up
        east = east / np.maximum(np.linalg.norm(east, axis=-1, keepdims=True), _TINY)
        body = np.stack([east, rotations.cross(up, east), up], -2)
        angle = self._angle(tau, u)
        c, s, zero = np.cos(angle), np.sin(angle), 0 * angle
        turn = np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, 1 + zero], -1)])
        return np.moveaxis(turn, 0, -2) @ body, spins

    @functools.cached_property
    def _waves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean precession rate [B, 1]; amplitudes and frequencies in u of the Fourier series of its integral."""
        quarter = elliptic_k(self.m1)
        grid = 2 * quarter[..., None] * np.arange(_SAMPLES) / _SAMPLES  # one period of the squared spins
        waves = np.fft.rfft(self.precession(self.spins(grid)), axis=-1) / _SAMPLES
        numbers = np.arange(1, _SAMPLES // 2)
        pace = np.where(self.rate > 0, self.rate * np.pi / quarter, 1.0)
        # The rates are even in u, so their series has only cosines, which integrate to sines.
        sizes = 2 * waves[..., 1:-1].real / (numbers * pace[..., None])
        sizes = np.where(self.rate[..., None] > 0, sizes, 0.0)
        return waves[..., :1].real, sizes, (np.pi / quarter)[..., None] * numbers

    def _angle(self, tau: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Integral of the precession rate, up to a constant per body. [B, S]"""
        mean, sizes, numbers = self._waves
        return mean * tau + (np.sin(u[..., None] * numbers[..., None, :]) @ sizes[..., None])[..., 0]


def _solve(body: np.ndarray, w: np.ndarray) -> _Path:
    values, vectors = np.linalg.eigh(body)
    if not values[0] > 0:
        raise ValueError(f"body: expected positive moments of inertia, got {values}")
    if np.linalg.det(vectors) < 0:
        vectors = -vectors
    values = values / values[2]
    middle = max(values[1], values[0] + _GAP)
    values = np.array([values[0], middle, max(values[2], middle + _GAP)])
    # The squares of faster spins overflow, so their poses are NaN.
    spins = np.where((np.abs(w) < _FASTEST).all(-1, keepdims=True), w, np.nan) @ vectors
    # L^2 - 2E I2. If negative, the spin circles the axis of the smallest moment, which becomes the third.
    circling = (values * spins**2 * (values - values[1])).sum(-1)
    flip = (circling < 0)[..., None]
    spins = np.where(flip, spins[..., ::-1] * [1, -1, 1], spins)
    moments = np.where(flip, values[::-1], values)
    axes = np.where(flip[..., None], vectors[:, ::-1] * [1, -1, 1], vectors)

    i1, i2, i3 = (moments[..., k] for k in range(3))
    # |2E I3 - L^2| and |L^2 - 2E I1|, as sums that do not cancel.
    low = np.abs((moments * spins**2 * (moments - moments[..., 2:])).sum(-1))
    high = np.abs((moments * spins**2 * (moments - moments[..., :1])).sum(-1))
    gap12, gap13, gap23 = np.abs(i1 - i2), np.abs(i1 - i3), np.abs(i2 - i3)
    side = np.where(spins[..., 2] < 0, -1.0, 1.0)
    order = np.where(i1 < i3, 1.0, -1.0)
    peaks = np.sqrt(np.stack([low / (i1 * gap13), low / (i2 * gap23), high / (i3 * gap13)], -1))
    peaks = peaks * np.stack([np.ones_like(side), side * order, side], -1)
    rate = np.sqrt(high * gap23 / (i1 * i2 * i3))
    m = np.where(high > 0, low * gap12 / np.maximum(high * gap23, _TINY), 0.0)
    m1 = np.abs(circling) * gap13 / np.maximum(high * gap23, _TINY)
    m1 = np.where(high > 0, np.clip(np.where(m < 0.5, 1 - m, m1), _MIN_M1, 1.0), 1.0)
    amplitude = np.arctan2(side * order * spins[..., 1] * np.sqrt(i2 * gap23), spins[..., 0] * np.sqrt(i1 * gap13))
    squares = (moments * peaks) ** 2
    pole = np.where(squares[..., 2] > np.minimum(squares[..., 0], squares[..., 1]), 0, 2)
    return _Path(axes, moments, peaks, rate, elliptic_f(amplitude, m1), m1, pole)


def _arithmetic_geometric_means(m1: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Arithmetic and geometric means a, b and half differences c of the AGM iteration from 1 and sqrt(1 - m)."""
    a, b = [np.ones_like(m1)], [np.sqrt(m1)]
    c = [np.sqrt(np.maximum(1 - m1, 0.0))]
    while len(a) < 12 and (c[-1] > 1e-17 * a[-1]).any():
        c.append(0.5 * (a[-1] - b[-1]))
        a.append(0.5 * (a[-1] + b[-1]))
        b.append(np.sqrt(a[-2] * b[-1]))
    return a, b, c


def elliptic_k(m1: np.ndarray) -> np.ndarray:
    """Complete elliptic integral K, a quarter period of sn, for parameters m = 1 - m1. [...]"""
    return 0.5 * np.pi / _arithmetic_geometric_means(np.asarray(m1, np.float64))[0][-1]


def elliptic_f(amplitude: np.ndarray, m1: np.ndarray) -> np.ndarray:
    """Incomplete elliptic integral F: u with sn u = sin(amplitude), cn u = cos(amplitude). Any angle. [...]"""
    a, b, _ = _arithmetic_geometric_means(np.asarray(m1, np.float64))
    phi = np.asarray(amplitude, np.float64)
    for x, y in zip(a[:-1], b[:-1], strict=True):
        turned = np.round(phi / np.pi)
        phi = phi + np.arctan((y / x) * np.tan(phi - np.pi * turned)) + np.pi * turned
    return phi / (2.0 ** (len(a) - 1) * a[-1])


def jacobi_elliptic(u: np.ndarray, m1: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobi's sn, cn, dn of u for parameters m = 1 - m1, broadcast. [...] each"""
    a, _, c = _arithmetic_geometric_means(np.asarray(m1, np.float64))
    phi = 2.0 ** (len(a) - 1) * a[-1] * u
    for x, z in zip(a[:0:-1], c[:0:-1], strict=True):
        phi = 0.5 * (phi + np.arcsin(np.clip(z / x * np.sin(phi), -1, 1)))
    sn, cn = np.sin(phi), np.cos(phi)
    return sn, cn, np.sqrt(cn**2 + m1 * sn**2)

"""Compact stored forms of the arrays of a scene file, with fewer bits than in memory.

quats, log_scales and opacity_logits are stored as int16 fixed point, sh, shading and residuals as float16 (rotations of
residuals as int16). An array that does not fit its form is stored as it is in memory.
"""

from __future__ import annotations

import numpy as np

from .array_types import DTYPES

# Fixed point: a stored int16 i represents i / scale.
FIXED_POINT = {"quats": 32767.0, "residual_quats": 32767.0, "log_scales": 2048.0, "opacity_logits": 1024.0}
HALF = ("sh", "shading", "residual_offsets", "residual_log_scales")
_QUATS = ("quats", "residual_quats")
_READ_BEFORE = 1e-7  # float32 rounding error of decoded components
_QUATS_AT_ONCE = 1 << 15  # rows per block, sized for the CPU cache
_LARGEST_HALF = 6e4


def encode(name: str, array: np.ndarray) -> np.ndarray:
    """Compact form of an array, or the array itself if the compact form cannot represent it."""
    if name in FIXED_POINT:
        scaled = _whole_units(array) if name in _QUATS else np.rint(array.astype(np.float64) * FIXED_POINT[name])
        fits = len(array) == 0 or np.abs(scaled).max() <= 32767
        return scaled.astype("<i2") if fits else array
    return as_half(array) if name in HALF else array


def decode(name: str, stored: np.ndarray) -> np.ndarray:
    """Array in its in-memory dtype from its compact form, or from the array itself."""
    if name in FIXED_POINT and stored.dtype == np.int16:
        values = stored.astype(np.float64) / FIXED_POINT[name]
        if name in _QUATS:
            norms = np.linalg.norm(values, axis=-1, keepdims=True)
            values = np.divide(values, norms, out=values, where=np.abs(norms - 1) < 1e-3)
        return values.astype(np.float32)
    return stored.astype(DTYPES[name])


def as_half(array: np.ndarray) -> np.ndarray:
    """The array as float16, or itself if it has numbers beyond that range."""
    return array.astype("<f2") if array.size == 0 or np.abs(array).max() < _LARGEST_HALF else array


def _whole_units(quats: np.ndarray) -> np.ndarray:
    """Quantised quaternions; for decoded ones, the stored integers that they were decoded from.

    Decoding normalises, so the stored integers may be slightly longer or shorter than a unit quaternion. Rounding the
    decoded values directly could then give neighbouring integers.
    """
    unit = FIXED_POINT["quats"]
    result = np.empty(quats.shape)
    for start in range(0, len(quats), _QUATS_AT_ONCE):
        wide = np.ascontiguousarray(
            quats[start : start + _QUATS_AT_ONCE].T, np.float64
        )  # by column, because numpy is slow on rows of four
        best = np.rint(wide * unit)
        for radius in (unit - 0.75, unit + 0.75):
            other = np.clip(np.rint(wide * radius), -unit, unit)
            norms = np.sqrt((other * other).sum(0))
            read = (np.abs(other - wide * norms) <= _READ_BEFORE * norms).all(0)
            best = np.where(read, other, best)
        result[start : start + _QUATS_AT_ONCE] = best.T
    return result

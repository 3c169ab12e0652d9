"""Photometric loss: (1 - w) L1 + w (1 - SSIM), value and gradient in one fused pass.

SSIM is the one of 3DGS: 11 x 11 Gaussian window of sigma 1.5, zero padding, constants 0.01 and 0.03, mean over pixels
and channels. With G* the (symmetric) blur and maps a = 2 mu1 mu2 + c1, b = 2 s12 + c2, c = mu1^2 + mu2^2 + c1,
d = s1 + s2 + c2, SSIM = a b / (c d); its gradient with respect to the first image x is
G*(dS/dmu1) + 2 x G*(dS/ds1) + y G*(dS/ds12), taken at fixed raw moments.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

_OFFSETS = np.arange(11) - 5
_WINDOW = np.exp(-(_OFFSETS**2) / (2 * 1.5**2))
WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)


def photometric(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) between two images.

    Args:
        image: Rendered image. [H, W, 3] float32
        target: Ground truth. [H, W, 3] float32
        ssim_weight: The weight w.

    Returns:
        The loss, a scalar; differentiable in ``image``.

    Source: 3D Gaussian Splatting (Kerbl et al. 2023), section 5.
    """
    return _Photometric.apply(image, target, ssim_weight)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, ssim_weight):
        x = image.detach().contiguous().numpy()
        y = target.contiguous().numpy()
        gradient = np.empty_like(x)
        value = _loss(x, y, np.float32(ssim_weight), WINDOW, gradient)
        ctx.gradient = torch.from_numpy(gradient)
        return image.new_tensor(value)

    @staticmethod
    def backward(ctx, upstream):
        return ctx.gradient * upstream, None, None


@numba.njit(cache=True, fastmath=True)
def _blur_rows(source, window, out):
    """Zero-padded 11-tap blur along axis 1 of [H, L] where neighbours lie ``3`` floats apart (interleaved channels)."""
    height, length = source.shape
    for r in range(height):
        for j in range(length):
            out[r, j] = 0.0
        for k in range(11):
            shift = 3 * (k - 5)
            w = window[k]
            first = max(0, -shift)
            last = min(length, length - shift)
            for j in range(np.uint64(last - first)):
                out[r, j + np.uint64(first)] += w * source[r, j + np.uint64(first + shift)]


@numba.njit(cache=True, fastmath=True)
def _blur_columns(source, window, out):
    height, length = source.shape
    for r in range(height):
        for j in range(length):
            out[r, j] = 0.0
        for k in range(11):
            q = r + k - 5
            if 0 <= q < height:
                w = window[k]
                for j in range(np.uint64(length)):
                    out[r, j] += w * source[q, j]


@numba.njit(cache=True, parallel=True, fastmath=True)
def _loss(image, target, weight, window, gradient):
    height, width, _ = image.shape
    length = width * 3
    n = np.float32(height * length)
    x = image.reshape(height, length)
    y = target.reshape(height, length)
    g = gradient.reshape(height, length)
    maps = np.empty((5, height, length), np.float32)
    for m in numba.prange(5):
        raw = np.empty((height, length), np.float32)
        rows = np.empty((height, length), np.float32)
        for r in range(height):
            for j in range(length):
                if m == 0:
                    raw[r, j] = x[r, j]
                elif m == 1:
                    raw[r, j] = y[r, j]
                elif m == 2:
                    raw[r, j] = x[r, j] * x[r, j]
                elif m == 3:
                    raw[r, j] = y[r, j] * y[r, j]
                else:
                    raw[r, j] = x[r, j] * y[r, j]
        _blur_rows(raw, window, rows)
        _blur_columns(rows, window, maps[m])
    partial = np.zeros((height, 2), np.float64)
    for r in numba.prange(height):
        for j in range(length):
            mu1 = maps[0, r, j]
            mu2 = maps[1, r, j]
            a = 2 * mu1 * mu2 + C1
            b = 2 * (maps[4, r, j] - mu1 * mu2) + C2
            c = mu1 * mu1 + mu2 * mu2 + C1
            d = maps[2, r, j] - mu1 * mu1 + maps[3, r, j] - mu2 * mu2 + C2
            inverse = np.float32(1.0) / (c * d)
            s = a * b * inverse
            partial[r, 0] += s
            partial[r, 1] += abs(x[r, j] - y[r, j])
            # Partial derivatives by the raw moments E[x], E[x^2], E[xy].
            maps[0, r, j] = 2 * mu2 * (b - a) * inverse - 2 * mu1 * s * (1 / c - 1 / d)
            maps[2, r, j] = -s / d
            maps[4, r, j] = 2 * a * inverse
    for which in numba.prange(3):
        m = 2 * which
        rows = np.empty((height, length), np.float32)
        _blur_rows(maps[m], window, rows)
        _blur_columns(rows, window, maps[m])
    l1 = (np.float32(1.0) - weight) / n
    ds = -weight / n
    for r in numba.prange(height):
        for j in range(length):
            difference = x[r, j] - y[r, j]
            slope = np.float32(0.0)
            if difference > 0:
                slope = l1
            elif difference < 0:
                slope = -l1
            g[r, j] = slope + ds * (maps[0, r, j] + 2 * x[r, j] * maps[2, r, j] + y[r, j] * maps[4, r, j])
    total_s = 0.0
    total_l = 0.0
    for r in range(height):
        total_s += partial[r, 0]
        total_l += partial[r, 1]
    return (1.0 - weight) * total_l / n + weight * (1.0 - total_s / n)

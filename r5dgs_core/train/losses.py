"""Photometric loss: (1 - w) L1 + w (1 - SSIM), value and gradient in one fused pass.

SSIM is the one of 3DGS: 11 x 11 Gaussian window of sigma 1.5, zero padding, constants 0.01 and 0.03, mean over pixels
and channels. With G* the (symmetric) blur and maps a = 2 mu1 mu2 + c1, b = 2 s12 + c2, c = mu1^2 + mu2^2 + c1,
d = s1 + s2 + c2, SSIM = a b / (c d); its gradient with respect to the first image x is
G*(dS/dmu1) + 2 x G*(dS/ds1) + y G*(dS/ds12), taken at fixed raw moments.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..raster import arrays, thread_pool
from ..raster import compilation as kernels

_REACH = 5  # of the window, px
_KEPT = 16  # rows in memory, at least the 11 of the window
_WORTH_A_THREAD = 32  # rows; each thread blurs and compares up to 20 rows of its neighbours again
_OFFSETS = np.arange(11) - 5
_WINDOW = np.exp(-(_OFFSETS**2) / (2 * 1.5**2))
WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
_NOTHING = np.zeros((0, 0), bool)  # no pixel is left out


def total(loss: Tensor, *terms: Tensor | None) -> Tensor:
    """Return the sum of a loss and further terms, in this order; None does not count."""
    for term in terms:
        loss = loss if term is None else loss + term
    return loss


def photometric(image: Tensor, target: Tensor, ssim_weight: float, left_out: np.ndarray | None = None) -> Tensor:
    """Return the loss (1 - w) L1 + w (1 - SSIM) between two images.

    Args:
        image: Rendered image. [H, W, 3] float32
        target: Ground truth. [H, W, 3] float32
        ssim_weight: The weight w.
        left_out: Pixels in which the target counts as equal to the image, which has no gradient there; None for no
            pixel. [H, W] bool

    Returns:
        The loss, a scalar; differentiable in ``image``.

    Source: 3D Gaussian Splatting (Kerbl et al. 2023), section 5.
    """
    return _Photometric.apply(image, target, ssim_weight, left_out)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, ssim_weight, left_out):
        if not arrays.takes_kernels(image):
            value, ctx.gradient = _in_torch(image.detach(), target, ssim_weight, left_out)
            return value
        x = image.detach().contiguous().numpy()
        y = target.contiguous().numpy()
        height, width, _ = x.shape
        shape = (height, 3 * width)
        x, y = x.reshape(shape), y.reshape(shape)
        sums = np.empty((height, 2), np.float64)
        gradient = np.empty(shape, np.float32)
        given = (x, y, _NOTHING if left_out is None else left_out, WINDOW, np.float32(ssim_weight), sums, gradient)
        thread_pool.run(_compare, height // _WORTH_A_THREAD, *given)
        similarity, difference = sums.sum(0) / x.size
        ctx.gradient = torch.from_numpy(gradient.reshape(height, width, 3))
        return image.new_tensor((1 - ssim_weight) * difference + ssim_weight * (1 - similarity))

    @staticmethod
    def backward(ctx, upstream):
        return ctx.gradient * upstream, None, None, None


def _in_torch(x: Tensor, y: Tensor, ssim_weight: float, left_out: np.ndarray | None) -> tuple[Tensor, Tensor]:
    """Return the loss and its gradient by the first image, by the formulas of the kernels. Inputs [H, W, 3], [H, W]"""
    inside = None if left_out is None else torch.from_numpy(left_out).to(x.device)[..., None]
    if inside is not None:
        y = torch.where(inside, x, y)
    images = torch.stack([x, y, x * x, y * y, x * y]).permute(0, 3, 1, 2)  # [5, 3, H, W]
    mu1, mu2, square1, square2, product = _blurred(images)
    mu11, mu22, mu12 = mu1 * mu1, mu2 * mu2, mu1 * mu2
    a, b = 2 * mu12 + float(C1), 2 * (product - mu12) + float(C2)
    c, d = mu11 + mu22 + float(C1), square1 - mu11 + square2 - mu22 + float(C2)
    inverse = 1 / (c * d)
    s = a * b * inverse
    by_mean = 2 * mu2 * (b - a) * inverse - 2 * mu1 * s * (1 / c - 1 / d)
    by_mean, by_square, by_product = _blurred(torch.stack([by_mean, -s / d, 2 * a * inverse])).permute(0, 2, 3, 1)
    difference = x - y
    chain = by_mean + 2 * x * by_square + y * by_product
    gradient = ((1 - ssim_weight) * difference.sign() - ssim_weight * chain) / x.numel()
    if inside is not None:
        gradient.masked_fill_(inside, 0.0)
    return (1 - ssim_weight) * difference.abs().mean() + ssim_weight * (1 - s.mean()), gradient


def _blurred(images: Tensor) -> Tensor:
    """Blur images with the window, with zeros around them. [B, 3, H, W]"""
    channels = images.flatten(0, 1)[:, None]
    # The variances are small differences of moments, for which TF32 is too coarse.
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        window = _window(images.device)
        channels = F.conv2d(channels, window[:, :, None], padding=(0, 5))
        channels = F.conv2d(channels, window[..., None], padding=(5, 0))
    return channels.view(images.shape)


@functools.cache
def _window(device: torch.device) -> Tensor:
    """Return the window on a device. [1, 1, 11]"""
    return torch.from_numpy(WINDOW).to(device)[None, None]


@kernels.kernel
def _compare(worker, workers, x, y, left_out, window, weight, sums, gradient):
    """Compute L1 and SSIM of this worker's rows, and the gradient of the loss with respect to x.

    The image passes in one sweep: row r is blurred along itself, row r - 5 is compared once the rows around it are
    there, and the gradient of row r - 10 once the rows around it are compared. Only the last `_KEPT` rows of each are
    in memory. Channels are interleaved: neighbours are 3 floats apart.

    Args:
        x, y: The images. [H, 3 W]
        left_out: Pixels in which y counts as equal to x, or none. [H, W] or [0, 0]
        window: Weights of the blur. [11]
        weight: Of SSIM in the loss.
        sums: Result, sums of SSIM and of the differences of each row. [H, 2]
        gradient: Result. [H, 3 W]
    """
    height, length = x.shape
    raw, full = np.empty((5, length), np.float32), np.empty((5, length), np.float32)
    moments, slopes = np.empty((_KEPT, 5, length), np.float32), np.empty((_KEPT, 3, length), np.float32)
    others = np.empty((_KEPT if len(left_out) else 0, length), np.float32)  # rows of y, with x where it is left out
    first, end = worker * height // workers, (worker + 1) * height // workers
    for row in range(first - 2 * _REACH, end + 2 * _REACH):
        if 0 <= row < height:
            if len(left_out):
                _mix(x[row], y[row], left_out[row], others[row % _KEPT])
            other = others[row % _KEPT] if len(left_out) else y[row]
            _blur_products(x[row], other, window, raw, moments[row % _KEPT])
        at = row - _REACH
        if max(first - _REACH, 0) <= at < min(end + _REACH, height):
            other = others[at % _KEPT] if len(left_out) else y[at]
            found = _compare_row(x[at], other, at, height, window, moments, raw, full, slopes[at % _KEPT])
            if first <= at < end:
                sums[at, 0], sums[at, 1] = found
        at = row - 2 * _REACH
        if first <= at < end:
            other = others[at % _KEPT] if len(left_out) else y[at]
            _write_gradient(x[at], other, at, height, window, weight, slopes, full, gradient[at])
            if len(left_out):
                _clear(gradient[at], left_out[at])


@kernels.helper
def _mix(x, y, left_out, out):
    """Copy a row of y, with x in the pixels that are left out."""
    for j in range(np.uint64(len(x))):
        out[j] = y[j]
    for pixel in range(len(left_out)):
        if left_out[pixel]:
            for j in range(3 * pixel, 3 * pixel + 3):
                out[j] = x[j]


@kernels.helper
def _clear(gradient, left_out):
    """Set the gradient of a row to zero in the pixels that are left out."""
    for pixel in range(len(left_out)):
        if left_out[pixel]:
            for j in range(3 * pixel, 3 * pixel + 3):
                gradient[j] = np.float32(0.0)


@kernels.helper
def _blur_products(x, y, window, raw, moments):
    """Blur x, y, x^2, y^2 and xy of a row along it."""
    for j in range(np.uint64(len(x))):
        raw[0, j] = x[j]
        raw[1, j] = y[j]
        raw[2, j] = x[j] * x[j]
        raw[3, j] = y[j] * y[j]
        raw[4, j] = x[j] * y[j]
    for m in range(5):
        _blur_row(raw[m], window, moments[m])


@kernels.helper
def _compare_row(x, y, r, height, window, moments, raw, full, slopes):
    """Compute SSIM of row r of images from the blurred moments, and its derivatives by these, blurred along the row.

    Returns the sums of SSIM and of the differences of the images.
    """
    length = len(x)
    one, two = np.float32(1.0), np.float32(2.0)
    for m in range(5):
        _blur_column(moments, m, r, height, window, full[m])
    similarity = 0.0
    difference = 0.0
    for j in range(length):
        mu1, mu2 = full[0, j], full[1, j]
        a = two * mu1 * mu2 + C1
        b = two * (full[4, j] - mu1 * mu2) + C2
        c = mu1 * mu1 + mu2 * mu2 + C1
        d = full[2, j] - mu1 * mu1 + full[3, j] - mu2 * mu2 + C2
        inverse = one / (c * d)
        s = a * b * inverse
        similarity += s
        difference += abs(x[j] - y[j])
        raw[0, j] = two * mu2 * (b - a) * inverse - two * mu1 * s * (one / c - one / d)
        raw[1, j] = -s / d
        raw[2, j] = two * a * inverse
    for m in range(3):
        _blur_row(raw[m], window, slopes[m])
    return similarity, difference


@kernels.helper
def _write_gradient(x, y, r, height, window, weight, slopes, full, gradient):
    """Compute the gradient of the loss by row r of x from the derivatives, blurred along the columns."""
    length = len(x)
    n = np.float32(height * length)
    l1 = (np.float32(1.0) - weight) / n
    share = -weight / n
    for m in range(3):
        _blur_column(slopes, m, r, height, window, full[m])
    for j in range(np.uint64(length)):
        difference = x[j] - y[j]
        sign = np.float32(difference > 0) - np.float32(difference < 0)
        chain = full[0, j] + np.float32(2.0) * x[j] * full[1, j] + y[j] * full[2, j]
        gradient[j] = l1 * sign + share * chain


@kernels.helper
def _blur_row(source, window, out):
    length = len(source)
    for j in range(np.uint64(length)):
        out[j] = np.float32(0.0)
    for k in range(11):
        shift = 3 * (k - 5)
        w = window[k]
        first, last = max(0, -shift), min(length, length - shift)
        if last > first:
            target, neighbours = out[first:last], source[first + shift : last + shift]
            for j in range(np.uint64(last - first)):
                target[j] += w * neighbours[j]


@kernels.helper
def _blur_column(rows, m, r, height, window, out):
    """Blur map ``m`` of row r along the columns, from the rows around it. ``rows`` are the last ones. [_KEPT, M, L]"""
    for j in range(np.uint64(len(out))):
        out[j] = np.float32(0.0)
    for k in range(11):
        q = r + k - _REACH
        if 0 <= q < height:
            w = window[k]
            row = rows[q % _KEPT, m]
            for j in range(np.uint64(len(out))):
                out[j] += w * row[j]

"""Error metrics of images, id maps and poses, as defined by the paper or the field.

Images are float in [0, 1], display-referred sRGB, [H, W, 3]. Id maps are integers, 0 = background, [H, W].
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import optimize

from ..motion import rotations

MSE_FLOOR = 1e-10  # limits PSNR to 100 dB, so that means stay finite for equal images
SSIM_RADIUS, SSIM_SIGMA = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def mse(image: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float:
    """Return the mean squared error over pixels and channels.

    Args:
        image: Rendered image. [H, W, 3]
        truth: Ground truth. [H, W, 3]
        where: Mask of the pixels to count; all if None. [H, W] bool

    Returns:
        The mean; NaN if the mask is empty.
    """
    _check_pair(image, truth)
    squared = (image.astype(np.float64) - truth.astype(np.float64)) ** 2
    if where is not None:
        squared = squared[where]
    return float(squared.mean()) if squared.size else math.nan


def psnr_of_mse(value: float) -> float:
    """Return the peak signal-to-noise ratio of a mean squared error, dB, at most 100."""
    return -10.0 * math.log10(max(value, MSE_FLOOR))


def psnr(image: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float:
    """Return the PSNR of an image over the pixels in ``where``, dB, at most 100; NaN if the mask is empty."""
    value = mse(image, truth, where)
    return math.nan if math.isnan(value) else psnr_of_mse(value)


def psnr_pooled(errors: Sequence[float]) -> float:
    """Return the PSNR of the mean of the images' squared errors, dB; NaN without images.

    It is at most the mean of their PSNRs.

    Source: FreeGave's ``MAEPSNR``, -10 log10(mean(10^(-PSNR / 10))).
    """
    return psnr_of_mse(float(np.mean(errors))) if len(errors) else math.nan


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the structural similarity of the windows around each pixel; its mean is that of 3D Gaussian Splatting.

    Window 11 x 11, Gaussian of sigma 1.5, zero padding, constants 0.01 and 0.03. Packages that pad by reflection or
    crop the border give other means (differences up to 0.007).

    Args:
        image: Rendered image. [H, W, 3]
        truth: Ground truth. [H, W, 3]

    Returns:
        Similarity per pixel and channel. [H, W, 3]

    Source: Wang et al. 2004, Eq. 13, with the padding of the 3DGS code.
    """
    _check_pair(image, truth)
    x, y = image.astype(np.float64), truth.astype(np.float64)
    mean_x, mean_y, xx, yy, xy = _blur(np.stack([x, y, x * x, y * y, x * y]))
    var_x, var_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_x**2 + mean_y**2 + SSIM_C1) * (var_x + var_y + SSIM_C2)
    return numerator / denominator


def flip(image: np.ndarray, truth: np.ndarray) -> float | None:
    """Return the mean FLIP error of display-referred images; None without `flip-evaluator` (extra ``metrics``)."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    _check_pair(image, truth)
    reference, test = (np.ascontiguousarray(np.clip(a, 0, 1), np.float32) for a in (truth, image))
    _, mean, _ = flip_evaluator.evaluate(reference, test, "LDR")
    return float(mean)


def confusion(
    predicted: np.ndarray, truth: np.ndarray, ids: Sequence[int], where: np.ndarray | None = None
) -> np.ndarray:
    """Count pixels by true and predicted id.

    Args:
        predicted: Predicted ids. [H, W]
        truth: True ids. [H, W]
        ids: Ids with a row and column of their own; all others, including -1, share the last row and column. (M,)
        where: Mask of the pixels to count; all if None. [H, W] bool

    Returns:
        Pixels with true id ``ids[i]`` and predicted id ``ids[j]``. [M + 1, M + 1] int64
    """
    if predicted.shape != truth.shape:
        raise ValueError(f"expected id maps of one size, got {predicted.shape} and {truth.shape}")
    if where is not None:
        predicted, truth = predicted[where], truth[where]
    order = np.argsort(ids)
    keys, count = np.asarray(ids)[order], len(ids)

    def index(values: np.ndarray) -> np.ndarray:
        at = np.minimum(np.searchsorted(keys, values), max(count - 1, 0))
        return np.where(keys[at] == values, order[at], count) if count else np.zeros(values.shape, np.int64)

    flat = index(truth).astype(np.int64) * (count + 1) + index(predicted)
    return np.bincount(flat.ravel(), minlength=(count + 1) ** 2).reshape(count + 1, count + 1)


def iou_table(counts: np.ndarray) -> np.ndarray:
    """Return the intersection over union of every true with every predicted id, 0 if both are absent. [M, M]

    Args:
        counts: `confusion`. [M + 1, M + 1]
    """
    true, predicted = counts.sum(axis=1)[:-1], counts.sum(axis=0)[:-1]
    common = counts[:-1, :-1].astype(np.float64)
    return common / np.maximum(true[:, None] + predicted[None, :] - common, 1)


def background_iou(counts: np.ndarray) -> float:
    """Return the IoU of the background, the pixels outside all ids; NaN if truth and prediction have none.

    Args:
        counts: `confusion`. [M + 1, M + 1]
    """
    common = int(counts[-1, -1])
    union = int(counts[-1].sum()) + int(counts[:, -1].sum()) - common
    return common / union if union else math.nan


def present(counts: np.ndarray) -> np.ndarray:
    """Mask of the ids that occur in the truth. [M + 1, M + 1] -> [M] bool"""
    return counts[:-1].sum(axis=1) > 0


def miou(counts: np.ndarray) -> float:
    """Return the mean IoU of the ids present in the truth with the same predicted id.

    Args:
        counts: `confusion`, of one image or summed over many (pooled). [M + 1, M + 1]

    Returns:
        The mean; NaN if the truth has none of the ids.
    """
    shown = present(counts)
    return float(np.diag(iou_table(counts))[shown].mean()) if shown.any() else math.nan


def match_ids(counts: np.ndarray) -> dict[int, int]:
    """Return the one-to-one map from true to predicted ids with the largest sum of IoU (Hungarian method).

    Args:
        counts: `confusion`. [M + 1, M + 1]

    Returns:
        Column of each row that is present in the truth; rows without overlap with a remaining column are missing.
    """
    shown = np.flatnonzero(present(counts))
    table = iou_table(counts)[shown]
    rows, columns = optimize.linear_sum_assignment(table, maximize=True)
    return {int(shown[i]): int(j) for i, j in zip(rows, columns, strict=True) if table[i, j] > 0}


def miou_matched(counts: np.ndarray) -> float:
    """Return the mean IoU as in `miou`, with predicted ids mapped by `match_ids`."""
    shown = present(counts)
    table = iou_table(counts)
    total = sum(float(table[i, j]) for i, j in match_ids(counts).items())
    return total / int(shown.sum()) if shown.any() else math.nan


def rotation_angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle between rotations in degrees, accurate near 0 and 180. [..., 3, 3], [..., 3, 3] -> [...]"""
    between = np.swapaxes(a, -1, -2) @ b
    axis = np.stack(
        [
            between[..., 2, 1] - between[..., 1, 2],
            between[..., 0, 2] - between[..., 2, 0],
            between[..., 1, 0] - between[..., 0, 1],
        ],
        axis=-1,
    )
    return np.degrees(np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(between, axis1=-2, axis2=-1) - 1.0))


def rigid(matrices: np.ndarray) -> np.ndarray:
    """Return object-to-world matrices without their scale. [..., 4, 4]"""
    out = np.array(matrices, np.float64)
    linear = out[..., :3, :3]
    out[..., :3, :3] = rotations.nearest_rotmats(linear / np.linalg.norm(linear, axis=-2, keepdims=True))
    return out


def true_motion(predicted: np.ndarray, truth: np.ndarray, observed: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the true motion of a bind state, from true poses in another frame of the object.

    The constant rigid offset A between both frames is the mean of P(t)^-1 T(t) over the observed times (chordal mean of
    the rotations), so that later differences are errors of the motion alone.

    Args:
        predicted: Map from the bind state to the world at each time, rigid. [T, 4, 4]
        truth: Object to world at the same times; scale is removed. [T, 4, 4]
        observed: Times from which the offset is estimated, at least one. [T] bool
        center: Center of the object in the bind state. [3]

    Returns:
        Map from the bind state to the world at each time, T(t) A^-1. [T, 4, 4]
    """
    if not observed.any():
        raise ValueError("observed: expected at least one time")
    poses = rigid(truth)
    offsets = np.linalg.inv(predicted[observed]) @ poses[observed]
    align = np.eye(4)
    align[:3, :3] = rotations.nearest_rotmats(offsets[:, :3, :3].mean(axis=0))
    # Average the translation at the center, because the object's origin may be far away.
    p_object = np.einsum("tij,tj->ti", np.linalg.inv(offsets), np.append(center, 1.0)[None].repeat(len(offsets), 0))
    align[:3, 3] = np.asarray(center) - align[:3, :3] @ p_object.mean(axis=0)[:3]
    return poses @ np.linalg.inv(align)


def pose_errors(predicted: np.ndarray, motion: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return center distances in world units and angles in degrees between two motions. [T, 4, 4] -> [T], [T]"""
    distances = np.linalg.norm(((predicted - motion) @ np.append(center, 1.0))[..., :3], axis=-1)
    return distances, rotation_angle_deg(predicted[..., :3, :3], motion[..., :3, :3])


def _check_pair(image: np.ndarray, truth: np.ndarray) -> None:
    if image.shape != truth.shape or image.ndim != 3:
        raise ValueError(f"expected two images [H, W, C] of one size, got {image.shape} and {truth.shape}")


def _blur(images: np.ndarray) -> np.ndarray:
    """Convolve with a separable Gaussian window, with zero padding. [B, H, W, C]"""
    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    window = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()
    for axis in (1, 2):
        length = images.shape[axis]
        width = [(SSIM_RADIUS, SSIM_RADIUS) if a == axis else (0, 0) for a in range(4)]
        padded = np.pad(images, width)
        images = np.zeros_like(images)
        for k, weight in enumerate(window.tolist()):
            images += weight * np.take(padded, np.arange(k, k + length), axis=axis)
    return images

"""Losses of identity encodings: cross-entropy of pixels with the masks, and agreement of spatial neighbours.

Notation: C classes, M queried Gaussians with k neighbours each; probabilities are softmaxes of the classifier's
outputs.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torch import Tensor

LOG_FLOOR = 1e-10  # added to probabilities before the logarithm
BLOCK_BYTES = 1 << 24  # classifier outputs per block


def pixel_cross_entropy(features: Tensor, weight: Tensor, bias: Tensor, target: Tensor) -> Tensor:
    """Return the mean cross-entropy of the classified pixels, divided by ln C so that guessing costs 1 for any C.

    Value and gradients are computed together in blocks of pixels, so that no array of all pixels and classes is needed.

    Args:
        features: Blended encodings of the pixels. [..., D]
        weight: Weight of the classifier. [C, D]
        bias: Bias of the classifier. [C]
        target: Class of each pixel, -1 for ignored pixels. [...] int64

    Returns:
        The loss, a scalar; 0 if all pixels are ignored. Differentiable once, in all but ``target``.

    Source: Gaussian Grouping (Ye et al. 2024), section 3.2.
    """
    return _PixelCrossEntropy.apply(features, weight, bias, target)


class _PixelCrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, bias, target):
        classes, dims = weight.shape
        pixels, wanted = features.detach().reshape(-1, dims), target.reshape(-1)
        weight, bias = weight.detach(), bias.detach()
        counted = (wanted >= 0).sum().clamp(min=1).double()
        share = (1 / (counted * math.log(max(classes, 2)))).to(pixels.dtype)
        total = pixels.new_zeros(())
        by_features, by_weight, by_bias = torch.empty_like(pixels), torch.zeros_like(weight), torch.zeros_like(bias)
        block = max(1, BLOCK_BYTES // (classes * pixels.element_size()))
        for first in range(0, len(pixels), block):
            part, goal = pixels[first : first + block], wanted[first : first + block]
            logs = F.log_softmax(torch.addmm(bias, part, weight.T), dim=1)
            counts = (goal >= 0)[:, None].to(logs.dtype)
            goal = goal.clamp(min=0)[:, None]
            total = total - (logs.gather(1, goal) * counts).sum()
            slopes = logs.exp_().scatter_add_(1, goal, torch.full_like(counts, -1.0)).mul_(counts * share)
            by_features[first : first + block] = slopes @ weight
            by_weight += slopes.T @ part
            by_bias += slopes.sum(0)
        ctx.save_for_backward(by_features.reshape(features.shape), by_weight, by_bias)
        return total * share

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, upstream):
        by_features, by_weight, by_bias = ctx.saved_tensors
        return by_features * upstream, by_weight * upstream, by_bias * upstream, None


def spatial_divergence(probabilities: Tensor, neighbours: Tensor, *, include_self: bool = False) -> Tensor:
    """Return the mean divergence between the classes of Gaussians and of their neighbours, L_3d.

    Args:
        probabilities: Class probabilities of the queried Gaussians. [M, C]
        neighbours: Class probabilities of the nearest other Gaussians of each, nearest first. [M, k, C]
        include_self: Count a Gaussian as its own nearest neighbour in place of the farthest one, as Gaussian Grouping
            does. One of its k divergences is then always 0.

    Returns:
        Mean over queries and neighbours of the Kullback-Leibler divergence of the query from the neighbour, divided by
        C; a scalar, 0 without queries or neighbours. Gradients reach both sides.

    Source: Gaussian Grouping (Ye et al. 2024), Eq. 4.
    """
    counted = neighbours.shape[1]
    if include_self:
        neighbours = neighbours[:, : counted - 1]
    if neighbours.numel() == 0:
        return (probabilities.sum() + neighbours.sum()) * 0
    ratios = torch.log(probabilities + LOG_FLOOR)[:, None] - torch.log(neighbours + LOG_FLOOR)
    divergences = (probabilities[:, None] * ratios).sum(-1)
    return divergences.sum() / (len(probabilities) * counted * probabilities.shape[1])


def majority_distance(probabilities: Tensor, neighbours: Tensor) -> Tensor:
    """Return the mean distance between the classes of Gaussians and the mean of their neighbours, L_major.

    Args:
        probabilities: Class probabilities of the queried Gaussians. [M, C]
        neighbours: Class probabilities of the nearest other Gaussians of each. [M, k, C]

    Returns:
        Mean squared Euclidean distance, a scalar, 0 without queries or neighbours. Gradients reach both sides.

    Source: R5DGS (Gridusov, Popov, Kolyubin), L_major; a Gaussian does not count among its own neighbours.
    """
    if neighbours.numel() == 0:
        return (probabilities.sum() + neighbours.sum()) * 0
    return ((probabilities - neighbours.mean(1)) ** 2).sum(-1).mean()


class Neighbourhood:
    """Nearest neighbours among fixed points.

    Args:
        points: The points. [N, 3]
    """

    def __init__(self, points: Tensor):
        self.points = points.detach().cpu().clone()
        self._tree = KDTree(self.points.numpy())

    def nearest(self, rows: Tensor, count: int) -> Tensor:
        """Return the rows of the nearest other points, nearest first.

        Args:
            rows: Queried points, on the CPU. [M] int64
            count: Neighbours of each, k.

        Returns:
            Rows of the neighbours. [M, min(k, N - 1)] int64
        """
        count = min(count, len(self.points) - 1)
        if count < 1 or len(rows) == 0:
            return rows.new_zeros(len(rows), max(count, 0))
        found = np.asarray(self._tree.query(self.points[rows].numpy(), count + 1)[1])
        # If points coincide, the tree may return others before the queried one, or not return it at all.
        own = found == rows.numpy()[:, None]
        own[~own.any(1), -1] = True
        return torch.from_numpy(found[~own].reshape(len(rows), count).astype(np.int64))

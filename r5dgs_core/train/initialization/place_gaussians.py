"""Initial Gaussians of bodies, of the background, and of shadows on the supporting plane.

Notation: P points. Lengths are in normalised coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from ...model.gaussians import Gaussians
from ...scene import spherical_harmonics
from . import shadows

SHADOW_OPACITY = 0.03
SHADOW_LIFT = (0.02, 0.01)  # minimum height above the plane, and range above it
SHADOW_THICKNESS = 0.01
SCALES = (0.005, 0.2)  # limits of the initial standard deviations
WIDEST = 0.25  # maximum standard deviation after thinning; wider Gaussians would soon be pruned


@dataclass(frozen=True)
class SeedPoints:
    """Points that become Gaussians.

    Attributes:
        means: Centres. [P, 3]
        colors: Display-referred RGB in [0, 1]. [P, 3]
        labels: Motion group. [P]
        opacities: In (0, 1). [P]
        log_scales: Logarithms of the standard deviations. [P, 3]
        quats: Unit wxyz. [P, 4]
    """

    means: np.ndarray
    colors: np.ndarray
    labels: np.ndarray
    opacities: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray


def solid(clouds: Sequence[tuple[np.ndarray, np.ndarray, int]], opacity: float) -> SeedPoints:
    """Return isotropic Gaussians with the spacing of their neighbours as size, over all clouds.

    Args:
        clouds: Centres [P, 3], colours [P, 3] and motion group of each cloud.
        opacity: Opacity of all of them.
    """
    means = np.concatenate([where for where, _, _ in clouds])
    return SeedPoints(
        means,
        np.concatenate([shade for _, shade, _ in clouds]),
        np.concatenate([np.full(len(where), group) for where, _, group in clouds]),
        np.full(len(means), opacity),
        _neighbour_scales(means),
        np.tile([1.0, 0, 0, 0], (len(means), 1)),
    )


def shadow(
    center: np.ndarray,
    radius: float,
    light: np.ndarray,
    plane: tuple[np.ndarray, float],
    group: int,
    count: int,
    rng: np.random.Generator,
) -> SeedPoints:
    """Return faint, flat, dark Gaussians in the shadow of a body on the plane.

    Args:
        center: Centre of the body. [3]
        radius: Radius of the body.
        light: Unit direction in which the light travels. [3]
        plane: Unit normal and offset of the supporting plane.
        group: Motion group of the shadow.
        count: Number of Gaussians.
        rng: Random generator.
    """
    normal, _ = plane
    jitter = rng.normal(size=(count, 3)) * 0.6 * radius
    lift = SHADOW_LIFT[0] + SHADOW_LIFT[1] * rng.random(count)
    jitter += (lift - jitter @ normal)[:, None] * normal
    size = np.full((count, 3), 0.25 * radius)
    size[:, 2] = SHADOW_THICKNESS
    return SeedPoints(
        shadows.cast(center, light, plane) + jitter,
        np.zeros((count, 3)),
        np.full(count, group),
        np.full(count, SHADOW_OPACITY),
        np.log(size),
        np.tile(_quat_from_z(normal), (count, 1)),
    )


def gaussians_of(parts: Sequence[SeedPoints], sh_degree: int) -> Gaussians:
    """Return the canonical Gaussians of all parts, in their order."""
    means, colors, labels, opacities, log_scales, quats = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("means", "colors", "labels", "opacities", "log_scales", "quats")
    )
    params = {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "opacity_logits": np.log(opacities / (1 - opacities)),
        "sh": spherical_harmonics.rgb_to_dc(colors)[:, None, :],
        "sh_rest": np.zeros((len(means), (sh_degree + 1) ** 2 - 1, 3)),
        "shading": np.zeros((len(means), 3)),
    }
    return Gaussians(
        {name: torch.from_numpy(np.asarray(value, np.float32)) for name, value in params.items()},
        torch.from_numpy(labels.astype(np.int64)),
    )


def shade_outwards(gaussians: Gaussians, centers: np.ndarray, length: float) -> None:
    """Give the Gaussians of bodies shading vectors that point away from the centre, as on a ball.

    Args:
        gaussians: Canonical Gaussians, changed in place.
        centers: Centres of the bodies, row 0 for the pinned group. [B, 3]
        length: Length of the vectors.
    """
    ids = gaussians.motion_ids
    bodies = (ids > 0) & (ids < len(centers))
    with torch.no_grad():
        ways = gaussians.means[bodies] - torch.from_numpy(centers).float()[ids[bodies]]
        gaussians.shading[bodies] = length * torch.nn.functional.normalize(ways, dim=1)


def thin(gaussians: Gaussians, cap: int, rng: np.random.Generator) -> Gaussians:
    """Keep ``cap`` Gaussians: the same share of every motion group, and at least one of each if possible.

    The remaining ones grow by the square root of the reduction so that surfaces stay covered, up to a size of `WIDEST`.

    Args:
        gaussians: The Gaussians before training.
        cap: Maximum number of them, at least 1.
        rng: Random generator; not used if no thinning is necessary.

    Returns:
        The remaining Gaussians in their order; ``gaussians`` itself if there are at most ``cap``.
    """
    count = len(gaussians)
    if count <= cap:
        return gaussians
    drawn = rng.permutation(count)
    ids = gaussians.motion_ids.numpy()[drawn]
    turn = np.zeros(count)  # order of selection: rank in the group / size of the group
    for group in np.unique(ids):
        members = ids == group
        turn[members] = np.arange(members.sum()) / members.sum()
    rows = torch.from_numpy(np.sort(drawn[np.argsort(turn, kind="stable")[:cap]]))
    params = {name: tensor.detach()[rows].clone() for name, tensor in gaussians.params.items()}
    room = math.log(WIDEST) - params["log_scales"].amax(1, keepdim=True)
    params["log_scales"] += room.clamp(0.0, 0.5 * math.log(count / cap))
    return Gaussians(params, gaussians.motion_ids[rows])


def _neighbour_scales(points: np.ndarray) -> np.ndarray:
    """Return the logarithm of the mean distance to the three nearest neighbours, clipped to `SCALES`. [P, 3]"""
    if len(points) < 4:
        return np.full((len(points), 3), np.log(0.05))
    distance, _ = KDTree(points).query(points, k=4)
    return np.repeat(np.log(np.clip(distance[:, 1:].mean(1), *SCALES))[:, None], 3, axis=1)


def _quat_from_z(normal: np.ndarray) -> np.ndarray:
    """Return the rotation from the z axis to ``normal``, wxyz."""
    axis = np.cross([0.0, 0, 1], normal)
    quat = np.array([1 + normal[2], *axis])
    return np.array([0.0, 1, 0, 0]) if np.linalg.norm(quat) < 1e-6 else quat / np.linalg.norm(quat)

"""Reference rasterizer in plain torch. Slow and exact: the oracle of the tests.

Everything is computed in float64, for inputs of any dtype; only results and gradients are rounded to it.

Notation: z depth, u = x / z and v = y / z slopes, P the axes of a Gaussian in px, one per column, C = P P^T + dilation
its covariance in px^2, T transmittance.

Long thin Gaussians cause no cancellation: det C and d^T C^-1 d are sums of squares (Cauchy-Binet), with x for the
cross product in the plane and k, l for columns of P:

    det C = sum over k < l of (P_k x P_l)^2 + dilation (|P|^2 + dilation)
    det C d^T C^-1 d = sum over k of (d x P_k)^2 + dilation |d|^2
"""

from __future__ import annotations

import torch
from torch.utils.checkpoint import checkpoint

from ..motion import rotations
from ..scene.cameras import Camera
from .settings import RasterSettings, RasterStats, SplatImage, frustum_slopes
from .torch_backend import TorchBackend

# A tile is the unit of work: all its pixels with all Gaussians that reach it. Neither constant affects results.
TILE = 32  # px; smaller tiles skip more Gaussians
TILE_WORK = 1 << 18  # pixels times Gaussians; tiles grow in scenes with few Gaussians


def project(
    means: torch.Tensor,  # [N, 3]
    quats: torch.Tensor,  # [N, 4]
    scales: torch.Tensor,  # [N, 3]
    camera: Camera,
    settings: RasterSettings,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Project Gaussians to the image.

    Args:
        means: Centres, world. [N, 3]
        quats: Rotations wxyz, any length; zero quaternions mean no rotation. [N, 4]
        scales: Standard deviations, world units. [N, 3]
        camera: The view.
        settings: Near plane and frustum clamp.

    Returns:
        Centres in px [N, 2], axes in px, one per column [N, 2, 3], depths [N]. Rows of Gaussians nearer
        than the near plane are finite but meaningless.

    Source: Zwicker et al. 2001, Eq. 31, with the Jacobian at a slope clamped to the frustum as in 3DGS.
    """
    T = torch.as_tensor(camera.T_cam_world, dtype=means.dtype, device=means.device)
    k = camera.intrinsics
    fx, skew, cx, fy, cy = float(k[0, 0]), float(k[0, 1]), float(k[0, 2]), float(k[1, 1]), float(k[1, 2])
    # Term by term: a matrix product may round equal rows differently, but equal centres need equal depths.
    a, b, c = means.unbind(1)
    x, y, z = (T[i, 3] + T[i, 0] * a + T[i, 1] * b + T[i, 2] * c for i in range(3))
    safe_z = torch.where(z > settings.near_plane, z, 1)
    u, v = x / safe_z, y / safe_z
    means2d = torch.stack([fx * u + skew * v + cx, fy * v + cy], 1)

    u_low, u_high, v_low, v_high = frustum_slopes(camera, settings)
    u, v = u.clamp(u_low, u_high), v.clamp(v_low, v_high)
    zero = torch.zeros_like(u)
    jacobian = torch.stack(
        [
            torch.stack([fx / safe_z, skew / safe_z, -(fx * u + skew * v) / safe_z], 1),
            torch.stack([zero, fy / safe_z, -fy * v / safe_z], 1),
        ],
        1,
    )
    return means2d, jacobian @ T[:3, :3] @ rotmats(quats) * scales[:, None, :], z


def rotmats(quats: torch.Tensor) -> torch.Tensor:
    """Convert quaternions wxyz of any length to rotation matrices; zero gives the identity. [N, 4] -> [N, 3, 3]"""
    square = (quats * quats).sum(1, keepdim=True)
    proper = square > 0
    length = torch.sqrt(torch.where(proper, square, 1))
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return rotations.quats_to_rotmats(torch.where(proper, quats / length, identity))


def covariances(axes: torch.Tensor, dilation: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Covariances C [N, 2, 2] of axes in px [N, 2, 3], and their determinants [N] as sums of squares."""
    area = torch.linalg.cross(axes[:, 0], axes[:, 1]).square().sum(1)
    determinant = area + dilation * (axes.square().sum((1, 2)) + dilation)
    return axes @ axes.transpose(1, 2) + dilation * torch.eye(2).to(axes), determinant


def radii(cov: torch.Tensor) -> torch.Tensor:
    """Three standard deviations along the long axis of each covariance. [N, 2, 2] -> [N]"""
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    return 3 * torch.sqrt(0.5 * (a + c) + torch.sqrt((0.5 * (a - c)) ** 2 + b * b))


def visible_rows(
    means2d: torch.Tensor,  # [N, 2]
    cov: torch.Tensor,  # [N, 2, 2]
    z: torch.Tensor,  # [N]
    opacities: torch.Tensor,  # [N]
    camera: Camera,
    settings: RasterSettings,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the Gaussians beyond the near plane whose ellipse of opacity ``alpha_min`` overlaps the image.

    Args:
        means2d: Centres, px. [N, 2]
        cov: Covariances with dilation, px^2. [N, 2, 2]
        z: Depths in the camera frame. [N]
        opacities: In [0, 1]. [N]
        camera: Gives the image size.
        settings: Near plane and alpha_min.

    Returns:
        Rows of the visible Gaussians, near to far, ties in row order [V]; half width and height of the ellipse of every
        Gaussian, px [N, 2].
    """
    reach = 2 * torch.log((opacities / settings.alpha_min).clamp_min(1))
    extent = torch.sqrt(reach[:, None] * torch.diagonal(cov, dim1=1, dim2=2))
    size = means2d.new_tensor([camera.width, camera.height])
    inside = ((means2d + extent > 0) & (means2d - extent < size)).all(1)
    seen = (z > settings.near_plane) & (opacities >= settings.alpha_min) & inside
    indices = torch.nonzero(seen)[:, 0]
    return indices[torch.argsort(z[indices], stable=True)], extent


def _overlapping(means2d, extent, box):
    """Mask of the Gaussians that may reach a pixel of the box (x0, y0, x1, y1). [V] bool"""
    low, high = means2d.new_tensor(box[:2]), means2d.new_tensor(box[2:])
    return ((means2d + extent > low) & (means2d - extent < high)).all(1)


def _blend(means2d, axes, opacities, values, labels, box, settings):
    """Blend depth-sorted Gaussians over the pixels of a box: values [h, w, D], transmittance [h, w], ids [h, w]."""
    x0, y0, x1, y1 = box
    x = torch.arange(x0, x1, dtype=means2d.dtype, device=means2d.device) + 0.5
    y = torch.arange(y0, y1, dtype=means2d.dtype, device=means2d.device) + 0.5
    shape = (len(y), len(x))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 1, 2)
    dx, dy = (pixels - means2d).unbind(-1)
    _, determinant = covariances(axes, settings.dilation)
    square = settings.dilation * (dx.square() + dy.square())
    for k in range(3):
        square = square + (dx * axes[:, 1, k] - dy * axes[:, 0, k]).square()
    power = -0.5 * square / determinant
    alpha = (opacities * torch.exp(power)).clamp_max(settings.alpha_max)
    alpha = torch.where(alpha >= settings.alpha_min, alpha, 0)

    with torch.no_grad():  # a pixel stops before the first Gaussian that would bring T below the minimum
        keep = torch.cumprod(1 - alpha, 1) >= settings.finished_at
    alpha = torch.where(keep, alpha, 0)
    # Sum logarithms of T: the gradient of a cumulative product divides by terms that may have underflowed.
    log_factors = torch.log1p(-alpha)
    log_passed = torch.cumsum(log_factors, 1)
    weights = alpha * torch.exp(log_passed - log_factors)
    transmittance = torch.exp(log_passed[:, -1]) if alpha.shape[1] else means2d.new_ones(len(pixels))
    ids = _heaviest(weights.detach(), labels, transmittance.detach(), settings)
    return (weights @ values).reshape(*shape, -1), transmittance.reshape(shape), ids.reshape(shape)


def _heaviest(weights, labels, transmittance, settings):
    """Label with the largest sum of weights per pixel, the smallest on ties, -1 if alpha is small. [P] int32"""
    ids = torch.full((len(weights),), -1, dtype=torch.int32, device=weights.device)
    if labels is None or not len(labels):
        return ids
    names, planes = torch.unique(labels.long().clamp_min(-1), return_inverse=True)  # ascending; max returns the first
    votes = weights.new_zeros((len(weights), len(names))).index_add_(1, planes, weights)
    most, winners = votes.max(1)
    enough = (1 - transmittance >= settings.id_alpha_min) & (most > 0)
    return torch.where(enough, names[winners].to(torch.int32), ids)


def _fill_stats(stats: RasterStats, cov: torch.Tensor, order: torch.Tensor, dtype: torch.dtype) -> None:
    """Write visibility and radii, and zero gradient norms."""
    visible = torch.zeros(len(cov), dtype=torch.bool, device=cov.device)
    visible[order] = True
    stats.visible = visible
    stats.radii = torch.where(visible, radii(cov), 0).to(dtype)
    stats.grad_norm = torch.zeros_like(stats.radii)


def _keep_norm(stats: RasterStats, gradient: torch.Tensor, dtype: torch.dtype) -> None:
    """Write the norms of the gradient by the projected centres; called in the backward pass."""
    stats.grad_norm = gradient.norm(dim=1).to(dtype)


class ReferenceBackend(TorchBackend):
    """Plain torch, for tensors of any float dtype on any device."""

    name = "reference"

    def rasterize_splats(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        channels: torch.Tensor,
        camera: Camera,
        background: torch.Tensor | None,
        labels: torch.Tensor | None,
        settings: RasterSettings,
        stats: RasterStats | None,
    ) -> SplatImage:
        """See `Backend.rasterize_splats`."""
        dtype, height, width = means.dtype, camera.height, camera.width
        means, quats, scales, opacities, channels = (t.double() for t in (means, quats, scales, opacities, channels))
        means2d, axes, z = project(means, quats, scales, camera, settings)
        with torch.no_grad():
            cov, _ = covariances(axes, settings.dilation)
            order, extent = visible_rows(means2d, cov, z, opacities, camera, settings)
            if stats is not None:
                _fill_stats(stats, cov, order, dtype)
        if stats is not None and means2d.requires_grad:
            means2d.register_hook(lambda gradient: _keep_norm(stats, gradient, dtype))
        inputs = [t[order] for t in (means2d, axes, opacities, torch.cat([channels, z[:, None]], 1))]
        kept_labels = None if labels is None else labels[order]
        centers, extent = inputs[0].detach(), extent[order]

        tile = TILE
        while 4 * tile * tile * max(len(order), 1) <= TILE_WORK:
            tile *= 2
        rows = []
        for y0 in range(0, height, tile):
            row = []
            for x0 in range(0, width, tile):
                box = (x0, y0, min(x0 + tile, width), min(y0 + tile, height))
                near = _overlapping(centers, extent, box)
                near_labels = None if kept_labels is None else kept_labels[near]
                arguments = (*(t[near] for t in inputs), near_labels, box, settings)
                # Checkpointing: otherwise the graph would keep every pixel-Gaussian pair of all tiles.
                row.append(checkpoint(_blend, *arguments, use_reentrant=False, preserve_rng_state=False))
            rows.append([torch.cat(parts, 1) for parts in zip(*row, strict=True)])
        blended, transmittance, ids = (torch.cat(parts, 0) for parts in zip(*rows, strict=True))
        alpha = 1 - transmittance
        covered = alpha > 0
        depth = torch.where(covered, blended[..., -1] / torch.where(covered, alpha, 1), 0)
        image = blended[..., :-1]
        if background is not None:
            image = image + transmittance[..., None] * background.double()
        return SplatImage(image.to(dtype), alpha.to(dtype), depth.to(dtype), None if labels is None else ids)


BACKEND = ReferenceBackend()

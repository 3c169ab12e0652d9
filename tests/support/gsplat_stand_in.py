"""A stand-in for gsplat in plain torch, for tests of the cuda backend on machines without a GPU.

It has the signatures, the tile lists, the float32 arithmetic and the cut-offs of the kernels of gsplat 1.5 and 1.6,
read from their sources. Tests with it check the backend's own code, not gsplat.
"""

import dataclasses

import torch

from r5dgs_core.raster import RasterSettings, cuda, reference
from r5dgs_core.scene.cameras import Camera

COMPILED_CHANNELS = {1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513}  # gsplat 1.5 and 1.6


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, sort=True):
    """Stands in for gsplat.isect_tiles: every tile that the box of a Gaussian touches, keyed by tile and depth bits."""
    assert means2d.shape == radii.shape == (1, depths.shape[1], 2) and radii.dtype == torch.int32 and sort
    low = torch.floor((means2d[0] - radii[0]) / tile_size).clamp_min(0).int()
    high = torch.ceil((means2d[0] + radii[0]) / tile_size).int()
    high = torch.minimum(high, torch.tensor([tile_width, tile_height], dtype=torch.int32))
    span = (high - low).clamp_min(0) * (radii[0] > 0).all(1, keepdim=True)
    counts = span[:, 0] * span[:, 1]
    pairs = torch.repeat_interleave(torch.arange(len(counts)), counts)
    step = torch.arange(len(pairs)) - (counts.cumsum(0) - counts)[pairs]
    x, y = low[pairs, 0] + step % span[pairs, 0], low[pairs, 1] + step // span[pairs, 0]
    depth_bits = depths[0].contiguous().view(torch.int32).long()[pairs]
    keys, order = torch.sort((y * tile_width + x) << 32 | depth_bits, stable=True)
    return None, keys, pairs.int()[order]


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    """Stands in for gsplat.isect_offset_encode: the first pair of each tile."""
    tiles = torch.arange(n_images * tile_height * tile_width)
    return torch.searchsorted(isect_ids >> 32, tiles).int().reshape(n_images, tile_height, tile_width)


def make_rasterizer(alpha_max):
    """Stand-in of gsplat.rasterize_to_pixels with this cap: each tile blends the Gaussians of its list in float32."""

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, image_width, image_height, tile_size, isect_offsets, flatten_ids
    ):
        if colors.shape[-1] not in COMPILED_CHANNELS:
            raise ValueError(f"Unsupported number of color channels: {colors.shape[-1]}")
        assert all(t.dtype == torch.float32 for t in (means2d, conics, colors, opacities))
        starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
        tile_height, tile_width = isect_offsets.shape[1:]
        image_rows = []
        for tile_y in range(tile_height):
            row = []
            for tile_x in range(tile_width):
                tile = tile_y * tile_width + tile_x
                near = flatten_ids[starts[tile] : starts[tile + 1]].long()
                y, x = torch.meshgrid(torch.arange(tile_size) + 0.5, torch.arange(tile_size) + 0.5, indexing="ij")
                dx = means2d[0, near, 0] - (x.reshape(-1, 1) + tile_x * tile_size)
                dy = means2d[0, near, 1] - (y.reshape(-1, 1) + tile_y * tile_size)
                xx, xy, yy = conics[0, near].unbind(1)
                sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
                alpha = (opacities[0, near] * torch.exp(-sigma)).clamp_max(alpha_max)
                alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0)
                alpha = torch.where(torch.cumprod(1 - alpha, 1) > 1e-4, alpha, 0)
                before = torch.nn.functional.pad(torch.cumprod(1 - alpha, 1), (1, 0), value=1.0)
                values = torch.cat([alpha * before[:, :-1] @ colors[0, near], 1 - before[:, -1:]], 1)
                row.append(values.reshape(tile_size, tile_size, -1))
            image_rows.append(torch.cat(row, 1))
        values = torch.cat(image_rows, 0)[None, :image_height, :image_width]
        return values[..., :-1], values[..., -1:]

    return rasterize_to_pixels


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d=0.3, near_plane=0.01, opacities=None
):
    """Stands in for gsplat.fully_fused_projection: float32, and boxes of the ellipses of alpha 1/255, whole pixels."""
    assert covars is None and all(t.dtype == torch.float32 for t in (means, quats, scales, viewmats, Ks))
    pose, lens = viewmats[0].detach().cpu().double().numpy(), Ks[0].detach().cpu().double().numpy()
    settings = RasterSettings(near_plane=near_plane, dilation=eps2d)
    means2d, axes, z = reference.project(means, quats, scales, Camera(width, height, lens, pose), settings)
    cov, determinant = reference.covariances(axes, eps2d)
    conics = torch.stack([cov[:, 1, 1], -cov[:, 0, 1], cov[:, 0, 0]], 1) / determinant[:, None]
    with torch.no_grad():
        reach = (2 * torch.log(opacities * 255)).clamp_min(0).sqrt().clamp_max(3.33)
        radii = torch.ceil(reach[:, None] * torch.diagonal(cov, dim1=1, dim2=2).sqrt())
        size = torch.tensor([width, height], device=means.device)
        seen = ((means2d + radii > 0) & (means2d - radii < size)).all(1) & (z >= near_plane) & (opacities >= 1 / 255)
        radii = torch.where(seen[:, None], radii, 0).int()
    return radii[None], means2d[None], z[None], conics[None], None


FUNCTIONS = (isect_tiles, isect_offset_encode, make_rasterizer(0.99), fully_fused_projection)
STAND_IN = cuda.Kernels(*FUNCTIONS, "1.6.0", 1 / 255, 0.99, 1e-4)
OLD_STAND_IN = dataclasses.replace(
    STAND_IN, rasterize_to_pixels=make_rasterizer(0.999), version="1.5.3", alpha_max=0.999
)

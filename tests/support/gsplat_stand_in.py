"""A stand-in for gsplat in plain torch, for tests of the cuda backend on machines without a GPU.

It has the signatures, the tile lists, the float32 arithmetic and the cut-offs of the kernels of gsplat 1.5 and 1.6,
read from their sources. Tests with it check the backend's own code, not gsplat.
"""

import dataclasses

import torch

from r5dgs_core.raster import cuda

COMPILED_CHANNELS = {1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513}  # gsplat 1.5 and 1.6


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height, sort=True):
    """Stands in for gsplat.isect_tiles: every tile that the box of a Gaussian touches, keyed by tile and depth bits."""
    assert means2d.shape == radii.shape == (1, depths.shape[1], 2) and radii.dtype == torch.int32 and sort
    low = torch.floor((means2d[0] - radii[0]) / tile_size).clamp_min(0).int()
    high = torch.ceil((means2d[0] + radii[0]) / tile_size).int()
    keys, pairs = [], []
    for row in range(depths.shape[1]):
        depth_bits = int(depths[0, row].view(torch.int32))
        for y in range(low[row, 1], min(int(high[row, 1]), tile_height)):
            for x in range(low[row, 0], min(int(high[row, 0]), tile_width)):
                keys.append((y * tile_width + x) << 32 | depth_bits)
                pairs.append(row)
    keys, order = torch.sort(torch.tensor(keys, dtype=torch.int64), stable=True)
    return None, keys, torch.tensor(pairs, dtype=torch.int32)[order]


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


STAND_IN = cuda.Kernels(isect_tiles, isect_offset_encode, make_rasterizer(0.99), "1.6.0", 1 / 255, 0.99, 1e-4)
OLD_STAND_IN = dataclasses.replace(
    STAND_IN, rasterize_to_pixels=make_rasterizer(0.999), version="1.5.3", alpha_max=0.999
)

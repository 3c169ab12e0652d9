"""Per-pixel coverage of groups of Gaussians: soft masks ranked by share, as in Cryptomatte.

Each group is blended as a channel that is 1 for its own Gaussians and 0 for all others. The result is the part of the
pixel in which the group is visible; the shares of all groups sum to the pixel's alpha.
"""

from __future__ import annotations

import numpy as np

from ..raster import rasterize
from ..raster.settings import RasterSettings
from ..scene import cameras
from ..scene.cameras import Camera
from . import posed_scene, scene_renderer

CHANNELS = 11  # groups per pass: three as colour, the rest as features; bounds the memory


def shares(
    posed: posed_scene.PosedScene,
    groups: np.ndarray,  # [N]
    camera: Camera,
    *,
    ranks: int,
    settings: RasterSettings,
    backend: str = "auto",
) -> tuple[np.ndarray, np.ndarray]:
    """Return the groups with the largest shares of each pixel.

    Args:
        posed: Gaussians in the world.
        groups: Group of each Gaussian; Gaussians with -1 only occlude others. [N] int
        camera: The camera.
        ranks: Number of groups to keep per pixel, >= 1.
        settings: Rasterizer settings.
        backend: Rasterizer, as for `rasterize`.

    Returns:
        Groups, padded with -1 [H, W, ranks] int32, and their shares in descending order, which sum to at most alpha
        [H, W, ranks] float32.
    """
    size = (ranks, camera.height * camera.width)
    best, found = np.zeros(size, np.float32), np.full(size, -1, np.int32)
    groups = np.asarray(groups, np.int64)
    gaussians, seen = scene_renderer.PosedGaussians(posed), cameras.translated(camera, -posed.origin)
    present = np.unique(groups[groups >= 0])
    for first in range(0, len(present), CHANNELS):
        chosen = present[first : first + CHANNELS]
        channels = np.zeros((len(groups), max(len(chosen), 3)), np.float32)
        channels[:, : len(chosen)] = groups[:, None] == chosen
        output = rasterize(
            gaussians, seen, channels[:, 3:], None, colors=channels[:, :3], settings=settings, backend=backend
        )
        assert output.features is not None  # features were passed
        values = np.concatenate([output.color, output.features], -1)[..., : len(chosen)].reshape(-1, len(chosen))
        for column, group in enumerate(chosen):
            _insert(best, found, values[:, column], int(group))
    shape = (camera.height, camera.width, ranks)
    return found.T.reshape(shape), best.T.reshape(shape)


def _insert(best: np.ndarray, found: np.ndarray, values: np.ndarray, group: int) -> None:
    """Merge the shares of one group [P] into the ranked ones [ranks, P]. Visits only pixels with a share."""
    pixels = np.flatnonzero(values > 0)
    shares, names = values[pixels], np.full(len(pixels), group, np.int32)
    for rank in range(len(best)):
        larger = np.flatnonzero(shares > best[rank, pixels])
        places = pixels[larger]
        passed, passed_names = best[rank, places], found[rank, places]
        best[rank, places], found[rank, places] = shares[larger], names[larger]
        shares[larger], names[larger] = passed, passed_names
        left = shares > 0
        pixels, shares, names = pixels[left], shares[left], names[left]

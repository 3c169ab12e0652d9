"""Background of the images: a learned sky (spherical harmonics of the viewing direction, world) or a fixed colour.

Degree 0 is a constant sky; a horizon gradient needs higher degrees. A fixed colour (transparent images) is stored as
degree 0 and is not trained.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..scene import cameras, spherical_harmonics
from ..scene.cameras import Camera
from .initialization import sky

BASES_BYTES = 1 << 29  # limit of the cache of harmonics per camera
ROWS = 32  # of an image whose harmonics are computed at once, for the processor's cache


class Background:
    """Sky colour by viewing direction.

    Args:
        coefficients: Initial coefficients. [Kb, 3]
        learned: True if they are trained.
    """

    def __init__(self, coefficients: Tensor, learned: bool):
        self.learned = learned
        self.params: dict[str, Tensor] = {"background": coefficients.detach().requires_grad_(learned)}
        self._bases: dict[tuple, Tensor] = {}

    def to(self, device: torch.device) -> Background:
        """Return the background on a device."""
        return Background(self.params["background"].detach().to(device), self.learned)

    def image(self, camera: Camera, basis: Tensor | None = None) -> Tensor:
        """Return the background of a camera: [3] if the colour is fixed, else [H, W, 3].

        Args:
            camera: The camera.
            basis: Harmonics of its pixels; those of `basis` if None. [H W, Kb]
        """
        coefficients = self.params["background"]
        if not self.learned:
            return spherical_harmonics.dc_to_rgb(coefficients[0]).clamp(0, 1)
        basis = self.basis(camera) if basis is None else basis
        return (basis @ coefficients + 0.5).clamp(0, 1).reshape(camera.height, camera.width, 3)

    def basis(self, camera: Camera) -> Tensor:
        """Return the harmonics of a camera's pixels, cached up to `BASES_BYTES`. [H W, Kb]

        The first cameras stay in the cache: as views are drawn in random order, replacing them would save no work.
        """
        coefficients, shape = self.params["background"], (camera.height, camera.width, 3)
        key = (*shape, camera.T_cam_world[:3, :3].tobytes(), camera.intrinsics.tobytes(), len(coefficients))
        if key in self._bases:
            return self._bases[key]
        basis = _harmonics(camera, len(coefficients)).to(coefficients.device)
        if sum(b.nbytes for b in self._bases.values()) + basis.nbytes <= BASES_BYTES:
            self._bases[key] = basis
        return basis


def _harmonics(camera: Camera, count: int) -> Tensor:
    """Return the first harmonics of a camera's pixels. [H W, count]"""
    result = torch.empty((camera.height, camera.width, count))
    for start in range(0, camera.height, ROWS):
        rays = cameras.pixel_rays(camera, slice(start, start + ROWS)).astype(np.float32)
        part = spherical_harmonics.basis(torch.from_numpy(rays), spherical_harmonics.degree_of(count))
        result[start : start + ROWS] = part
    return result.reshape(-1, count)


def fixed(color: np.ndarray) -> Background:
    """Return a background of one fixed colour [3]."""
    return Background(torch.from_numpy(spherical_harmonics.rgb_to_dc(np.asarray(color, np.float32)))[None], False)


def learned(coefficients: np.ndarray, degree: int = sky.DEGREE) -> Background:
    """Return a sky of a given degree to be trained, initialised with coefficients [Kb, 3] and zeros for the rest."""
    start = torch.zeros((degree + 1) ** 2, 3)
    given = torch.from_numpy(np.asarray(coefficients, np.float32))[: len(start)]
    start[: len(given)] = given
    return Background(start, True)

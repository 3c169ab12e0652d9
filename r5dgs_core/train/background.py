"""The learned sky: spherical harmonics over the world's viewing direction, behind everything.

A constant sky is its first coefficient; a horizon gradient needs the next ones. Views with a fixed background colour
(transparent images) use the first coefficient alone and do not train it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..scene import cameras, sh_color
from ..scene.cameras import Camera
from .initialization import sky

BASES_BYTES = 1 << 29  # what the harmonics of the cameras' rays may take before they are made anew


class Background:
    """Sky colour by viewing direction.

    Args:
        coefficients: Start values. [Kb, 3]
        learned: Whether they are trained.
    """

    def __init__(self, coefficients: Tensor, learned: bool):
        self.learned = learned
        self.params: dict[str, Tensor] = {"background": coefficients.detach().requires_grad_(learned)}
        self._bases: dict[tuple, Tensor] = {}

    def image(self, camera: Camera) -> Tensor:
        """Colours behind the pixels of a camera: [3] for a fixed colour, else [H, W, 3]."""
        coefficients = self.params["background"]
        if not self.learned:
            return sh_color.dc_to_rgb(coefficients[0]).clamp(0, 1)
        shape = (camera.height, camera.width, 3)
        key = (*shape, camera.T_cam_world[:3, :3].tobytes(), camera.intrinsics.tobytes(), len(coefficients))
        if key not in self._bases:
            rays = torch.from_numpy(cameras.pixel_rays(camera).reshape(-1, 3).astype(np.float32))
            basis = sh_color.basis(rays, sh_color.degree_of(len(coefficients)))
            if sum(b.nbytes for b in self._bases.values()) + basis.nbytes > BASES_BYTES:
                self._bases.clear()
            self._bases[key] = basis
        return (self._bases[key] @ coefficients + 0.5).clamp(0, 1).reshape(shape)


def fixed(color: np.ndarray) -> Background:
    """A background of one colour that is not trained. [3]"""
    return Background(torch.from_numpy(sh_color.rgb_to_dc(np.asarray(color, np.float32)))[None], False)


def learned(coefficients: np.ndarray, degree: int = sky.DEGREE) -> Background:
    """A trained sky of a degree that starts at given coefficients, the missing ones at zero. [Kb, 3]"""
    start = torch.zeros((degree + 1) ** 2, 3)
    given = torch.from_numpy(np.asarray(coefficients, np.float32))[: len(start)]
    start[: len(given)] = given
    return Background(start, True)

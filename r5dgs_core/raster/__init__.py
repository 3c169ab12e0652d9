"""Gaussian rasterizer for arrays, and for tensors with gradients.

Backends: `cpu` (numba), `cuda` (gsplat) and `reference` (torch).
"""

from . import environment as environment  # first: validates variables that numba reads
from .rasterizer import rasterize, rasterize_splats
from .settings import DRAFT, RasterSettings, RasterStats, RenderOutput, SplatImage

__all__ = ["DRAFT", "RasterSettings", "RasterStats", "RenderOutput", "SplatImage", "rasterize", "rasterize_splats"]

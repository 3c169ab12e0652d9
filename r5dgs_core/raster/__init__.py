"""Differentiable rasterizer of Gaussians, one signature: `cpu` (numba), `cuda` and `reference` (plain torch)."""

from . import environment as environment  # first, as it checks what numba reads when it is imported
from .rasterizer import rasterize, rasterize_splats
from .settings import RasterSettings, RasterStats, RenderOutput, SplatImage

__all__ = ["RasterSettings", "RasterStats", "RenderOutput", "SplatImage", "rasterize", "rasterize_splats"]

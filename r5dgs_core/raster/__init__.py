"""Differentiable rasterizer of Gaussians, one signature: `cpu` (numba), `cuda` and `reference` (plain torch)."""

from . import environment as environment  # first, as it checks what numba reads when it is imported
from .settings import RasterSettings, RasterStats, RenderOutput, SplatImage
from .splatting import rasterize, rasterize_splats

__all__ = ["RasterSettings", "RasterStats", "RenderOutput", "SplatImage", "rasterize", "rasterize_splats"]

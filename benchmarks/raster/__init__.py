"""Benchmarks of the rasterizer. Run ``python -m benchmarks.raster COMMAND --help``."""

"""The `cpu` backend: numba kernels for projection, tiling, blending and spherical harmonics."""

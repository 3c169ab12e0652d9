"""Benchmarks of the rasterizer.

    python -m benchmarks.raster COMMAND [OPTIONS]

    speed         time and memory of forward and backward passes, also of other renderers
    error         image error and time of the rasterizer's settings
    extreme       difference between backend and reference on stiff and extreme scenes
    frames        whole frames of a moving scene
    static_layer  a static layer against drawing everything
    harmonics     colors from spherical harmonics, kernels against plain torch
    first_frame   first frame of a new process
    workloads     properties of the workloads

Results: docs/results/rasterizer.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

"""Benchmarks of pictures after t_max.

    python -m benchmarks.extrapolation COMMAND [OPTIONS]

    modes       pose error and PSNR of playback modes and motion models, of runs
    appearance  causes of the image error

Results: docs/results/report.md and docs/results/training.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

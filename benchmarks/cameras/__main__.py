"""Benchmarks of training with cameras that are wrong or few.

    python -m benchmarks.cameras COMMAND [OPTIONS]

    jitter  quality with wrong poses and colours, refined or not
    few     quality with a few of the cameras

Results: docs/results/captures.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

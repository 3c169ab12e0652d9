"""Benchmarks of training with cameras that are wrong.

    python -m benchmarks.cameras COMMAND [OPTIONS]

    board         a real capture: poses of a ChArUco board that a person carries
    dirty         from videos to a scene: wrong cameras against exact ones
    jitter        quality with wrong poses and colours, refined or not
    uncalibrated  cameras reconstructed from the images against calibrated ones

Results: docs/results/captures.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

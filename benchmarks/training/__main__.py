"""Benchmarks of training.

    python -m benchmarks.training COMMAND [OPTIONS]

    curve           quality against training time
    step            time of one step
    memory          peak memory by phase
    length          peak memory and time against the number of frames
    image_size      quality at several image sizes
    reconstruction  start from the points of a large COLMAP reconstruction
    held_out_times  quality between the observed times
    full_length     tables of finished benchmarks of several networks and lengths
    network_playback  frame rate with the networks in the loop

Results: docs/results/training.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

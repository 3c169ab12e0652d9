"""Benchmarks of motion past t_max, on simulated tracks and on rendered scenes.

    python -m benchmarks.futures COMMAND [OPTIONS]

    accuracy  error, confidence band, events and run time of the fit, for each kind of motion
    rendered  tracks and predictions of scenes that are rendered, trained and baked
    textures  textures of a ball that count as seen

Results: docs/results/predicted_motion.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

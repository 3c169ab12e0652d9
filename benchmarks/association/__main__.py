"""Benchmarks of mask association (`r5dgs associate`).

    python -m benchmarks.association COMMAND [OPTIONS]

    synthetic    degraded masks of synthetic scenes, repaired; --large measures time and memory
    trained      degraded masks of a data set, repaired by a trained run, and runs trained with each
    large_scene  time and memory of the whole command on a large scene

Results: docs/results/association.md.
"""

from ..commands import run

if __name__ == "__main__":
    run(__package__, __doc__)

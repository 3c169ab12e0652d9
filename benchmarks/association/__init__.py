"""Benchmarks of mask association (`r5dgs associate`). Run ``python -m benchmarks.association COMMAND --help``."""

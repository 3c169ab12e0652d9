"""Benchmarks of pictures after t_max. Run ``python -m benchmarks.extrapolation COMMAND --help``."""

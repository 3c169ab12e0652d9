"""Benchmarks of training. Run ``python -m benchmarks.training COMMAND --help``."""

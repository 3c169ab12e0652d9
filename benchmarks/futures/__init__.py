"""Benchmarks of motion past t_max on simulated tracks. Run ``python -m benchmarks.futures COMMAND --help``."""

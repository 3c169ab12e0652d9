"""Benchmarks of training with cameras that are wrong."""

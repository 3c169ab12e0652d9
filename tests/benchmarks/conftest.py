"""Fixtures of the benchmarks' tests: the tiny data set, one training of it and its scene."""

from tests.core.conftest import baked, tiny, trained

__all__ = ["baked", "tiny", "trained"]

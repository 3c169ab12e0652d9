"""Splits of a data set. Needs only the standard library, for the command line."""

from __future__ import annotations

SPLITS = ("train", "val", "test")

"""Splits of a data set. Only needs the standard library, for the command line."""

from __future__ import annotations

SPLITS = ("train", "val", "test")

"""Calibration formats: one module each, with `detect` and `read`, listed in `registry`."""

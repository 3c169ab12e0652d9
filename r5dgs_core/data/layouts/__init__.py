"""Layouts of data sets on disk: one module each, with `detect` and `read`, listed in `registry`."""

"""Calibrated cameras with their lenses, read from the files of other programs (`reading.read_calibration`)."""

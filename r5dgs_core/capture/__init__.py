"""Cameras of real captures: calibrations, lenses, undistortion, and reconstruction without a calibration."""

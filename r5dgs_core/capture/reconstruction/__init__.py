"""Cameras without a calibration: from image features (`features`) or from a calibration board (`board_cameras`)."""

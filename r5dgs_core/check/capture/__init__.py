"""Checks of a capture: mistakes of cameras, clocks and masks that training cannot repair, each with a picture."""

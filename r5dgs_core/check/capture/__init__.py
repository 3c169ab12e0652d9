"""Checks of a capture: mistakes of cameras, clocks and masks, each with a picture."""

"""Colour transforms of Gaussians: tints and the inverse of a view transform."""

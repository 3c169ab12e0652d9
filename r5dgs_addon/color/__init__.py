"""Colour management: view transforms, their inverses and the error of the inversion."""

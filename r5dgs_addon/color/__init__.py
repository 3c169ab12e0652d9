"""Colour management: view transforms, their inverses and the loss of the inversion."""

"""Evaluate a `Scene` at any time: poses of its motion groups and Gaussians moved by them."""

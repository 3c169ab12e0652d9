"""Shared modules of the scene builders: materials, shapes, toys, motions, and the capture of a scene."""

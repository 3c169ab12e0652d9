"""Shared modules of the scene builders: materials, shapes, toys, laws of motion, and the capture of a scene."""

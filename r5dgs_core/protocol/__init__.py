"""Requests between Blender and the worker: dataclasses of both sides, and checks of everything that is received."""

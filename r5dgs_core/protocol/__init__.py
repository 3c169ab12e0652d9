"""Requests between Blender and the worker: dataclasses of both sides, and checks of all received data."""

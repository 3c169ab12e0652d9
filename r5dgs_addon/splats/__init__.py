"""Gaussian splats in 3D viewports, drawn with Blender's `gpu` module."""

"""Loaded scenes in Blender: collections, point clouds, object names, display and selection."""

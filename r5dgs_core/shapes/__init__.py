"""Shapes of objects: convex hulls with their mass properties, and visible surfaces from depth pictures."""

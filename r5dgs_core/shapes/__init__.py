"""Surfaces of Gaussians: convex hulls of objects, and visible surfaces from depth pictures."""

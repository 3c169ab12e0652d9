"""Export scenes, Gaussians, cameras and masks from Blender."""

"""R5DGS core: semantic 4D Gaussians, their motion and their rendering. Does not depend on Blender."""

__version__ = "0.1.0"

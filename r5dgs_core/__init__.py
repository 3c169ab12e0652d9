"""R5DGS core: semantic 4D Gaussians, their motion and their rendering. Standalone: no Blender here."""

__version__ = "0.1.0"

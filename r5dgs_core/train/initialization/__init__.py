"""Initial Gaussians, object positions and sky from images, cameras and masks."""

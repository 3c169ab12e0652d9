"""Selection of single Gaussians, by criteria or in the viewport, to delete them or assign them to another object."""

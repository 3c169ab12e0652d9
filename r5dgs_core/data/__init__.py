"""Data sets on disk: images, cameras, masks, object names and ground truth."""

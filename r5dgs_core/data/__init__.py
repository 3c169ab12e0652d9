"""Reading of data sets: images, cameras, masks, object names and ground truth."""

"""The worker process of the Blender extension: JSON requests in, pixels and arrays out."""

"""The worker process of the Blender add-on: JSON requests in, pixels and arrays out."""

"""Motion of loaded objects: F-curves, editable physics, extrapolation and Exact Mode."""

"""Motion of loaded objects: F-curves, editable physics, extrapolation, contacts, rigid bodies and Exact Mode."""

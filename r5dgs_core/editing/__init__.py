"""Turn a `Scene` that was edited in Blender into a `Scene` that can be saved or drawn."""

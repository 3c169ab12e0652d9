"""Bake a checkpoint into a `Scene`, with the table of what the scene needs."""

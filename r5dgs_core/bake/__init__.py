"""Bake a checkpoint into a `Scene`, with the table of its needs."""

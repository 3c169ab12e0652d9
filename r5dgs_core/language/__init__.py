"""Embeddings of objects and phrases: build the lookup table of a scene and answer queries."""

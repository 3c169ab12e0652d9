"""Find objects of a scene by words: names, aliases and stored embeddings, without a network."""

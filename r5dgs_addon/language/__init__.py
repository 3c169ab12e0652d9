"""Selection of objects by prompt: prompt state, search and phrase embeddings."""

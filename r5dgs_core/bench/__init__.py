"""``r5dgs bench``: every variant trained on every scene, measured alike, and laid out in the paper's two tables."""

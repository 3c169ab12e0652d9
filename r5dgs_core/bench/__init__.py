"""``r5dgs bench``: train every variant on every scene, measure all in the same way, and write the paper's tables."""

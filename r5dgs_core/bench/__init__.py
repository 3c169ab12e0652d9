"""``r5dgs bench``: train every variant on every scene, measure all alike, and write the paper's two tables."""

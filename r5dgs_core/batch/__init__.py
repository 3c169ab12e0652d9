"""``r5dgs batch``: train, bake and evaluate many captures, each as a job of this machine or of a Slurm cluster."""

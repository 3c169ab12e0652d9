"""Training: the run, the trainer, losses and checkpoints."""

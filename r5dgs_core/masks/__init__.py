"""Object masks: creation with SAM2, reading of existing ones, and mask folders."""

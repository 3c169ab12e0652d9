"""Object masks: creation with SAM2 or SAM3, reading of existing ones, and mask folders."""

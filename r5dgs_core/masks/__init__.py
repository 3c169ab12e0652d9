"""Make object masks with SAM2 and write mask folders."""

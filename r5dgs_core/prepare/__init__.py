"""`r5dgs prepare`: turns videos or frames of calibrated or unknown cameras into a data set."""

"""`r5dgs prepare`: turns videos or frames of calibrated cameras into a data set."""

"""Give masks with inconsistent ids one numbering, by the Gaussians that each segment shows."""

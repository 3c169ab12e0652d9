"""Densification strategies: gradient-based cloning and splitting, and MCMC."""

"""Fit motion models to observed poses and choose among them."""

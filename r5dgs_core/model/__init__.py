"""Trainable modules: Gaussians, deformation field, TRD, tracks and residual field."""

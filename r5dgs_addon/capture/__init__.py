"""Capture a training data set from any .blend with Cycles."""

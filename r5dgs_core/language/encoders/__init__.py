"""Text and image encoders, loaded from local folders."""

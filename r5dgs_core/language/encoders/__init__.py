"""Text and image encoders that are read from a local folder."""

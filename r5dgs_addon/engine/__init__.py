"""Render engine: worker requests, viewport drawing, passes and previews."""

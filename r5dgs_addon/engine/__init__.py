"""The render engine: requests to the worker, viewport, passes and previews."""

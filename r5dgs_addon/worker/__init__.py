"""The add-on's side of the worker process: start it, send jobs and read its answers."""

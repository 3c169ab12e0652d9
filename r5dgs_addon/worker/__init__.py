"""Client of the worker process: start it, submit jobs and read responses."""

"""Python processes that start with the large packages imported, forked by a server: seconds less for each.

Systems without fork start them anew.
"""

import multiprocessing
import os
import subprocess
import sys
import tempfile
from pathlib import Path

FORKS = "forkserver" in multiprocessing.get_all_start_methods()
CONTEXT = multiprocessing.get_context("forkserver" if FORKS else "spawn")
if FORKS:
    CONTEXT.set_forkserver_preload(["torch._dynamo", "numba", "scipy.stats", "matplotlib.figure", "OpenImageIO"])


def run(code: str, *arguments: object, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Run code as `python -c` does, in a process without modules of this project; capture its output."""
    given = [str(argument) for argument in arguments]
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(folder) / name) for name in ("out", "err")]
        process = CONTEXT.Process(target=_run, args=(code, given, *paths))
        process.start()
        process.join(timeout)
        if process.is_alive():
            process.kill()
            raise subprocess.TimeoutExpired(code, timeout)
        assert process.exitcode is not None
        return subprocess.CompletedProcess(given, process.exitcode, *(Path(path).read_text() for path in paths))


def _run(code: str, arguments: list[str], *paths: str) -> None:
    for descriptor, path in enumerate(paths, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    sys.argv = ["-c", *arguments]
    exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})

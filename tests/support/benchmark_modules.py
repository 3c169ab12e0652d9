"""The programs of ``benchmarks/`` as modules, for the tests that call into them."""

import contextlib
import importlib
import sys
from pathlib import Path

import torch

from r5dgs_core.raster import thread_pool

ROOT = Path(__file__).parents[2]


@contextlib.contextmanager
def importing(monkeypatch):
    """Give a function that imports a module of the benchmarks by name, such as "raster.speed".

    Afterwards these modules are forgotten, and the numbers of threads are what they were.
    """
    before = thread_pool.threads(), torch.get_num_threads()
    monkeypatch.syspath_prepend(str(ROOT))
    hidden = _forget()
    try:
        yield lambda name: importlib.import_module(f"benchmarks.{name}")
    finally:
        _forget()
        sys.modules.update(hidden)
        thread_pool.set_threads(before[0])
        torch.set_num_threads(before[1])


def _forget():
    """Remove the modules of the benchmarks from `sys.modules`; returns them by name."""
    names = [name for name in sys.modules if name.partition(".")[0] == "benchmarks"]
    return {name: sys.modules.pop(name) for name in names}

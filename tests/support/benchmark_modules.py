"""The programs of ``benchmarks/`` as modules, for the tests that call into them."""

import contextlib
import importlib
import sys
from pathlib import Path

import torch

from r5dgs_core.raster import compilation

FOLDER = Path(__file__).parents[2] / "benchmarks"


@contextlib.contextmanager
def importing(monkeypatch):
    """Give a function that imports a benchmark by name, as running it as a script would.

    Afterwards its modules are forgotten, and the numbers of threads are what they were.
    """
    before = compilation.threads(), torch.get_num_threads()
    monkeypatch.syspath_prepend(str(FOLDER))
    names = [path.stem for path in FOLDER.glob("*.py")]
    hidden = {name: sys.modules.pop(name) for name in names if name in sys.modules}
    try:
        yield importlib.import_module
    finally:
        for name in names:
            sys.modules.pop(name, None)
        sys.modules.update(hidden)
        compilation.set_threads(before[0])
        torch.set_num_threads(before[1])

"""Wall time of each kernel of the `cpu` backend, and of the rest of the call."""

from __future__ import annotations

import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from r5dgs_core.raster import thread_pool

PACKAGES = ("r5dgs_core.raster.", "r5dgs_core.render.")


def measure(run: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median wall milliseconds of each kernel that ``run()`` calls, in order of their first call, then of the rest.

    The kernels must have been compiled, so ``run`` is called once before anything is measured.
    """
    run()
    calls: list[dict[str, float]] = []
    with _watch() as spent:
        for _ in range(repeats):
            spent.clear()
            start = time.perf_counter()
            run()
            whole = 1e3 * (time.perf_counter() - start)
            calls.append({**spent, "rest of the call": whole - sum(spent.values())})
    names = dict.fromkeys(name for call in reversed(calls) for name in call if name != "rest of the call")
    return {name: statistics.median(call.get(name, 0.0) for call in calls) for name in [*names, "rest of the call"]}


@contextmanager
def _watch() -> Iterator[dict[str, float]]:
    """Record milliseconds by kernel while the context lasts, by wrapping the kernels and `thread_pool.run` in their
    modules.
    """
    spent: dict[str, float] = defaultdict(float)
    inside = [False]  # a kernel that `run` calls is not counted twice; only the calling thread looks at this

    def wrap(function: Any, name_of: Callable[[tuple], str]) -> Callable:
        def timed(*arguments):
            arguments = tuple(getattr(argument, "timed_kernel", argument) for argument in arguments)
            if inside[0]:
                return function(*arguments)
            inside[0] = True
            start = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                inside[0] = False
                spent[name_of(arguments)] += 1e3 * (time.perf_counter() - start)

        timed.timed_kernel = function  # type: ignore[attr-defined]
        return timed

    runners = {thread_pool.run, thread_pool.run_parts}
    replaced = []
    for module in [m for name, m in sys.modules.items() if name.startswith(PACKAGES)]:
        for name, value in list(vars(module).items()):
            if isinstance(value, Callable) and value in runners:
                wrapper = wrap(value, lambda arguments: arguments[0].py_func.__name__)
            elif hasattr(value, "py_func"):
                wrapper = wrap(value, lambda _, value=value: value.py_func.__name__)
            else:
                continue
            replaced.append((module, name, value))
            setattr(module, name, wrapper)
    try:
        yield spent
    finally:
        for module, name, value in replaced:
            setattr(module, name, value)

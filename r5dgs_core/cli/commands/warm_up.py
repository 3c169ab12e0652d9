"""The command ``r5dgs warm-up``: compile the kernels."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from ... import errors
from .. import options

NAME = "warm-up"
SHORT = "compile the kernels now instead of on first use"
LONG = "Compile the rasterizing and training kernels now, so that the first picture or training run does not wait."
EXAMPLE = ""
PAGE = "reference/rasterizer.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_warm_up(progress_kind=args.progress)


def run_warm_up(*, progress_kind: str) -> dict[str, Any]:
    """Compile the rasterizing and training kernels, so that the first picture does not wait for them.

    Args:
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        ``seconds`` of run time, number of kernels ``compiled`` (0 if all were cached) and the cache ``folder`` (None if
        no folder can be written).
    """
    from ...progress import make

    try:
        from ...raster import compilation, kernel_cache
        from ...train import warm_up
    except ImportError as error:
        raise errors.BackendError(f"warm-up: {sys.executable} lacks '{error.name}'; install r5dgs again") from error

    with (
        make(progress_kind) as progress,
        compilation.announcing(lambda text: progress({"event": "notice", "text": text})),
    ):
        seconds = warm_up.warm_up(lambda stage: progress({"event": "prepare", "text": stage}))
        folder = kernel_cache.cache_folder()
        compiled = compilation.compiled()
        result = {"seconds": round(seconds, 2), "compiled": compiled, "folder": None if folder is None else str(folder)}
        if progress_kind == "json":
            progress({"event": "ready", **result})
    if progress_kind != "json":
        done = f"compiled {compiled} kernels in {seconds:.1f} s" if compiled else f"ready: loaded in {seconds:.1f} s"
        print(f"{done}; kept in {folder}" if folder else f"{done}; not kept, because no cache folder can be written")
    return result

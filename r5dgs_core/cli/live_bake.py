"""Process that bakes the newest checkpoint of a run for `live_run`: the player's page and the contact sheet.

    python -m r5dgs_core.cli.live_bake RUN FOLDER [--until T] [--objects WORDS] [--idle] [--end-with-input]

With ``--idle`` the process lowers its own priority first, so that the training is not delayed. With
``--end-with-input`` it ends with its standard input, which the system closes if the process at the other end is gone.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
from pathlib import Path

from .. import errors


def lower_priority() -> None:
    """Give this process only the time that no other process wants, as far as the system supports it."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(19)
    with contextlib.suppress(OSError):  # Linux shares time between sessions first, whatever the processes in them
        Path("/proc/self/autogroup").write_text("19")
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def end_with_input() -> None:
    """End this process at the end of its standard input."""

    def read() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=read, daemon=True).start()


def make(run: Path, folder: Path, until: float | None = None, words: str | None = None) -> None:
    """Write ``scene.html`` and ``contact_sheet.png`` of a run into a folder, each atomically.

    Raises:
        R5dgsError: The run cannot be baked yet, or an argument does not suit its scene.
    """
    from .. import atomic_files
    from ..bake import bake
    from ..data import dataset as datasets
    from ..evaluation import contact_sheet
    from ..formats import html
    from ..train import run_folder
    from . import live_run
    from .commands import export

    opened = run_folder.open_run(run)
    dataset = datasets.read(opened.data(), opened.config.data.masks, opened.config.data.min_registered)
    scene = bake.bake(opened, dataset)
    page = html.page(scene, export.selection(html.FORMAT, scene, until=until, words=words))
    atomic_files.write(folder / live_run.SCENE, page)
    contact_sheet.write(scene, dataset.relative_to(scene.origin), folder / live_run.SHEET)


def main() -> int:
    """Run the program; returns its exit status."""
    p = argparse.ArgumentParser()
    p.add_argument("run", type=Path)
    p.add_argument("folder", type=Path)
    p.add_argument("--until", type=float)
    p.add_argument("--objects")
    p.add_argument("--idle", action="store_true")
    p.add_argument("--end-with-input", action="store_true")
    args = p.parse_args()
    if args.end_with_input:
        end_with_input()
    if args.idle:
        lower_priority()
    try:
        make(args.run, args.folder, args.until, args.objects)
    except errors.R5dgsError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The command ``r5dgs bake``: convert a run to a scene file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ... import folder_lock, input_paths, terminal
from ...config import config
from .. import inputs, options

if TYPE_CHECKING:
    from ...scene.scene import Scene

NAME = "bake"
SHORT = "convert a run to a scene file"
LONG = "Convert a trained run to the .r5dgs file that Blender loads, and print a summary of the scene."
EXAMPLE = "RUN --out scene.r5dgs"
PAGE = "user/training.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("run", type=Path, help="run folder")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set folder, if it was moved")
    options.add_overrides(p, "needs.NAME=on|off", "override a detected need of the scene")
    p.add_argument("--needs", action="store_true", help="also print the table of the scene's needs")
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"with_needs": args.needs, "threads": args.threads, "progress_kind": args.progress}
    run_bake(args.run, args.out, args.data, options.overrides(args), **given)


@folder_lock.writes("out")
def run_bake(
    run_folder: Path,
    out: Path,
    data: Path | None,
    overrides: Sequence[str] = (),
    *,
    with_needs: bool = False,
    threads: int | None = None,
    progress_kind: str = "none",
) -> Scene:
    """Convert a run to a scene file (see `bake.bake.run_bake`) and print a summary, optionally with the needs table."""
    input_paths.check_scene_output(out)
    config.require_needs(overrides)
    input_paths.check_run(run_folder)
    if data is not None:
        inputs.check_dataset(data)

    from ...bake import bake
    from ...evaluation import evaluation_table, scene_summary
    from ...progress import make

    options.use_threads(threads)
    with make(progress_kind) as progress:
        progress({"event": "bake", "text": "motion models and scene file"})
        scene = bake.run_bake(run_folder, out, data, overrides)
        if progress_kind == "json":
            progress({"event": "written", "scene": str(out)})
    if progress_kind == "json":
        return scene
    print(f"written: {terminal.printable(str(out))}\n{scene_summary.summary(scene, out)}")
    if with_needs:
        terminal.console().print(evaluation_table.needs(scene.needs))
    return scene

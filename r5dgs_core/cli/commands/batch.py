"""The command ``r5dgs batch``: train, bake and evaluate many captures as jobs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ... import input_paths, terminal
from .. import options

NAME = "batch"
SHORT = "train, bake and evaluate many captures as jobs"
LONG = (
    "Train, bake and evaluate the captures of a TOML file, each as a job of this machine or of a Slurm cluster, and "
    "write one table. Repeat the same command to continue."
)
EXAMPLE = "captures.toml --out runs --cluster slurm"
PAGE = "user/batch.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("captures", type=Path, metavar="FILE", help="TOML file with a table [[capture]] for each data set")
    p.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="output folder for runs, scenes and the table"
    )
    shown = "where jobs run: as processes of this machine, or in Slurm (default: local)"
    p.add_argument("--cluster", choices=("local", "slurm"), default="local", help=shown)
    count = "maximum number of jobs at the same time (default: 1 for local, 1000 for slurm)"
    p.add_argument("--jobs", type=options.at_least(1), metavar="N", help=count)
    again = "repetitions of a job that is killed or crashes, from its last checkpoint (default: 1)"
    p.add_argument("--retries", type=options.at_least(0), default=1, metavar="N", help=again)
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_batch(
        args.captures,
        args.out,
        cluster=args.cluster,
        at_once=args.jobs,
        retries=args.retries,
        threads=args.threads,
        progress_kind=args.progress,
    )


def run_batch(
    path: Path,
    out: Path,
    *,
    cluster: str = "local",
    at_once: int | None = None,
    retries: int = 1,
    threads: int | None = None,
    progress_kind: str = "auto",
) -> dict[str, Any]:
    """Train, bake and evaluate the captures of a file (see `batch.jobs.run`), and print the table.

    Returns:
        The content of ``batch.json`` (docs/user/batch.md).
    """
    input_paths.check_output_folder("--out", out)
    from ...batch import captures

    planned = captures.read(path)
    captures.check_resources(path, planned.resources, cluster)
    from ...batch import jobs, table
    from ...batch.capture_job import CaptureJob, separate_gpus, visible_gpus
    from ...progress import make
    from ...train import interrupt

    out.mkdir(parents=True, exist_ok=True)
    at_once = at_once or (1 if cluster == "local" else 1000)
    gpus = visible_gpus(cluster, planned.resources)
    selectable = separate_gpus(cluster, planned.resources) if at_once > 1 else ()
    work = [CaptureJob(capture, out.resolve(), threads, gpus, selectable) for capture in planned.captures]
    start = jobs.executor(cluster, out.resolve() / captures.JOBS_FOLDER, planned.resources)
    with make(progress_kind) as progress, interrupt.at_once("stopped; repeat the same command to continue"):
        result = jobs.run(work, start, at_once=at_once, retries=retries, progress=progress)
    if progress_kind != "json":
        terminal.console().print(table.to_rich(result))
        print(f"table:  {out / captures.TABLE_FILE}\nresult: {out / captures.RESULT_FILE}")
    return result

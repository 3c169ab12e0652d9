"""The command ``r5dgs report``: measure error against run time, or test numerical stability."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ... import errors, input_paths, terminal
from .. import inputs, options
from ..exit_status import ExitStatus

NAME = "report"
SHORT = "measure error against run time, or test numerical stability"
LONG = (
    "Measure error against run time of motion models, playback modes and rasterizer settings. With --stability,\n"
    "run the stiff and extreme cases of the motion code instead; the exit status is 1 if a case fails."
)
EXAMPLE = "RUN --out report"
PAGE = "user/report.md"

TASKS = ("dynamics", "poses", "images", "raster")  # of `error_vs_time.report_rows`
SPLITS = ("train", "val", "test")  # of `data.dataset`


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("target", type=Path, nargs="?", metavar="RUN|SCENE", help="run folder or .r5dgs file")
    p.add_argument("data", type=Path, nargs="?", metavar="DATA", help="data set (default: the run's own)")
    p.add_argument("--out", type=Path, metavar="DIR", help="output folder for report.json, .csv, .md and .png")
    tasks = f"tasks to measure, of {', '.join(TASKS)} (default: all)"
    p.add_argument("--tasks", nargs="+", choices=TASKS, metavar="TASK", help=tasks)
    splits = "splits whose images are compared, of val, test (default: test)"
    p.add_argument("--splits", nargs="+", choices=SPLITS, metavar="SPLIT", help=splits)
    p.add_argument("--repeats", type=options.at_least(1), metavar="N", help="timing rounds (default: 7)")
    clock = "clock for timings: wall (default), or cpu for processor time"
    p.add_argument("--clock", choices=("wall", "cpu"), default="wall", help=clock)
    stability = "run the stiff and extreme cases instead; needs no scene"
    p.add_argument("--stability", action="store_true", help=stability)
    p.add_argument("--json", type=Path, metavar="FILE", help="write the results of --stability to this file")
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> ExitStatus | None:
    """Run the command."""
    measured = (args.target, args.out, args.tasks, args.splits, args.repeats)
    if args.stability and any(given is not None for given in measured):
        raise errors.UsageError("report --stability: needs no scene; takes --json FILE alone")
    if args.json is not None and not args.stability:
        raise errors.UsageError("report --json: is for --stability; a report's JSON goes to --out DIR/report.json")
    shared = {"threads": args.threads, "progress_kind": args.progress}
    if args.stability:
        return None if run_stability(args.json, **shared) else ExitStatus.NEGATIVE
    if args.target is None or args.out is None:
        raise errors.UsageError("report: expected RUN|SCENE and --out DIR, or --stability")
    given = {"tasks": args.tasks, "splits": args.splits, "rounds": args.repeats, "clock": args.clock}
    run_report(args.target, args.data, args.out, **given, **shared)
    return None


def run_report(
    target: Path,
    data: Path | None,
    out: Path,
    *,
    tasks: Sequence[str] | None = None,
    splits: Sequence[str] | None = None,
    rounds: int | None = None,
    clock: str = "wall",
    threads: int | None = None,
    progress_kind: str = "none",
) -> dict[str, Any]:
    """Measure error against run time of a run or scene file (see `error_vs_time.report`) and write it to a folder.

    Args:
        target: Run folder or ``.r5dgs`` file.
        data: Data set; if None, that of the run; a scene file is then measured without data.
        out: Folder of ``report.json``, ``.csv``, ``.md`` and ``.png``.
        tasks: Tasks to measure; all if None.
        splits: Splits whose images are compared; "test" if None.
        rounds: Timing rounds; `error_vs_time.report.ROUNDS` if None.
        clock: "wall", or "cpu" for processor time.
        threads: Threads of the kernels; see `options.use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The report, in the form of ``report.json``.
    """
    inputs.check_target(target, data)
    input_paths.check_output_folder("--out", out)
    from ...error_vs_time import report, report_rows, tables
    from ...progress import make

    options.use_threads(threads)
    with make(progress_kind) as progress:
        progress({"event": "prepare", "text": "the scene"})
        scene, dataset = inputs.open_target(target, data)
        if dataset is None and tasks and set(tasks) <= {"images", "poses"}:
            given = " ".join(tasks)
            raise errors.ConfigError(f"--tasks {given}: require the data set: r5dgs report {target} DATA --out {out}")
        result = report.measure(
            scene,
            dataset,
            tasks=tasks or report_rows.TASKS,
            splits=splits or ("test",),
            rounds=rounds or report.ROUNDS,
            clock=clock,
            progress=progress,
        )
    paths = report.write(result, out)
    if progress_kind != "json":
        tables.show(result)
        print("\n".join(f"written: {path}" for path in paths))
    return result


def run_stability(json_path: Path | None = None, *, threads: int | None = None, progress_kind: str = "none") -> bool:
    """Run the stiff, extreme and degenerate cases on this installation and print the results.

    Args:
        json_path: JSON file of the results, or None.
        threads: Threads of the kernels; see `options.use_threads`.
        progress_kind: Form of progress output (`progress.make`); "json" prints no table.

    Returns:
        True if all cases passed.
    """
    input_paths.check_output("--json", json_path)

    from ... import stability
    from ...progress import make
    from ...stability import training

    options.use_threads(threads)
    with make(progress_kind) as progress:
        cases = (*stability.CASES, *training.CASES)
        rows = stability.run(
            cases,
            lambda done: progress({"event": "stability", "done": done, "total": len(cases), "unit": "cases"}),
        )
    if progress_kind != "json":
        terminal.console().print(stability.make(rows))
        print(stability.summary(rows))
    if json_path is not None:
        stability.write(rows, json_path)
        if progress_kind != "json":
            print(f"written: {json_path}")
    return all(row.passed for row in rows)

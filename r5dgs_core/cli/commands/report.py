"""The command ``r5dgs report``: measure error against run time, or test numerical stability."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ... import errors, input_paths, terminal
from ...data.splits import SPLITS
from ...error_vs_time import task_names
from .. import inputs, options
from ..exit_status import ExitStatus

NAME = "report"
SHORT = "measure error against run time, or test numerical stability"
LONG = (
    "Measure error against run time of motion models, playback modes, rasterizer settings and training. Several runs\n"
    "of a scene are combined into medians with their spread. With --stability, run the stiff and extreme cases of\n"
    "the motion code instead; the exit status is 1 if a case fails."
)
EXAMPLE = "RUN [RUN ...] --out report"
PAGE = "user/report.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    paths = "run folders or .r5dgs files; a data set applies to those before it (default: the run's own)"
    p.add_argument("paths", type=Path, nargs="*", metavar="RUN|SCENE|DATA", help=paths)
    p.add_argument("--out", type=Path, metavar="DIR", help="output folder for report.json, .csv, .md and .png")
    tasks = f"tasks to measure, of {', '.join(task_names.TASKS)} (default: all)"
    p.add_argument("--tasks", nargs="+", choices=task_names.TASKS, metavar="TASK", help=tasks)
    splits = "splits whose images are compared, of val, test (default: test)"
    p.add_argument("--splits", nargs="+", choices=SPLITS, metavar="SPLIT", help=splits)
    p.add_argument("--repeats", type=options.at_least(1), metavar="N", help="timing rounds (default: 7)")
    clock = "clock for timings: wall (default), or cpu for processor time"
    p.add_argument("--clock", choices=("wall", "cpu"), default="wall", help=clock)
    options.add_lpips(p)
    stability = "run the stiff and extreme cases instead; needs no scene"
    p.add_argument("--stability", action="store_true", help=stability)
    p.add_argument("--json", type=Path, metavar="FILE", help="write the results of --stability to this file")
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> ExitStatus | None:
    """Run the command."""
    measured = (args.paths or None, args.out, args.tasks, args.splits, args.repeats, args.lpips)
    if args.stability and any(given is not None for given in measured):
        raise errors.UsageError("report --stability: takes no scene and no other output than --json FILE")
    if args.json is not None and not args.stability:
        raise errors.UsageError("report --json: applies to --stability only; --out DIR writes DIR/report.json")
    shared = {"threads": args.threads, "progress_kind": args.progress}
    if args.stability:
        return None if run_stability(args.json, **shared) else ExitStatus.NEGATIVE
    if not args.paths or args.out is None:
        raise errors.UsageError("report: expected RUN|SCENE and --out DIR, or --stability")
    given = {"tasks": args.tasks, "splits": args.splits, "rounds": args.repeats, "clock": args.clock}
    given["lpips"] = args.lpips
    run_report(pair(args.paths), args.out, **given, **shared)
    return None


def pair(paths: Sequence[Path]) -> list[tuple[Path, Path | None]]:
    """Return runs and scene files, each with its data set or None.

    A folder without ``run.json`` behind a run is a data set. It applies to all runs since the data set before it.
    """
    found: list[tuple[Path, Path | None]] = []
    open_ones: list[Path] = []
    for path in paths:
        if open_ones and path.is_dir() and not (path / input_paths.RUN_FILE).exists():
            found += [(target, path) for target in open_ones]
            open_ones = []
        else:
            open_ones.append(path)
    return found + [(target, None) for target in open_ones]


def run_report(
    targets: Sequence[tuple[Path, Path | None]],
    out: Path,
    *,
    tasks: Sequence[str] | None = None,
    splits: Sequence[str] | None = None,
    rounds: int | None = None,
    clock: str = "wall",
    lpips: Sequence[Path] | None = None,
    threads: int | None = None,
    progress_kind: str = "none",
) -> dict[str, Any]:
    """Measure error against run time of runs or scene files (see `error_vs_time.report`) and write it to a folder.

    Args:
        targets: Run folders or ``.r5dgs`` files, with their data sets; None for that of the run; a scene file is then
            measured without data.
        out: Folder of ``report.json``, ``.csv``, ``.md`` and ``.png``.
        tasks: Tasks to measure; all if None.
        splits: Splits whose images are compared; "test" if None.
        rounds: Timing rounds; `error_vs_time.report.ROUNDS` if None.
        clock: "wall", or "cpu" for processor time.
        lpips: Files of the weights of LPIPS; those of the user's settings if None.
        threads: Threads of the kernels; see `options.use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The report, in the form of ``report.json``.
    """
    _check_targets(targets)
    input_paths.check_output_folder("--out", out)
    weights = options.lpips_files(lpips)
    from ...error_vs_time import report, tables
    from ...progress import make

    options.use_threads(threads)
    settings = report.Options(
        tuple(tasks or task_names.TASKS),
        tuple(splits or ("test",)),
        rounds or report.ROUNDS,
        clock,
        perceptual=options.lpips_network(weights),
    )
    measured = []
    with make(progress_kind) as progress:
        for target, data in targets:
            progress({"event": "prepare", "text": str(target)})
            scene, dataset = inputs.open_target(target, data)
            if dataset is None:
                _check_tasks(tasks or (), f"r5dgs report {target} DATA --out {out}")
            measured.append(report.measure(scene, dataset, settings, place=target, progress=progress))
    result = report.collect(measured, settings)
    paths = report.write(result, out)
    if progress_kind != "json":
        tables.show(result)
        print("\n".join(f"written: {path}" for path in paths))
    return result


def _check_tasks(tasks: Sequence[str], remedy: str) -> None:
    """Raise ConfigError if all of some tasks need a data set."""
    from ...error_vs_time.tasks import BY_NAME

    if tasks and all(BY_NAME[name].needs_data for name in tasks):
        raise errors.ConfigError(f"--tasks {' '.join(tasks)}: require the data set: {remedy}")


def _check_targets(targets: Sequence[tuple[Path, Path | None]]) -> None:
    """Raise R5dgsError if a path is given twice, or is neither a run folder, a scene file nor a data set."""
    for target, data in targets:
        inputs.check_target(target, data)
    names = [target.resolve() for target, _ in targets]
    twice = next((target for target, _ in targets if names.count(target.resolve()) > 1), None)
    if twice is not None:
        raise errors.UsageError(f"report: {twice}: is given twice, which would make the spread too small")


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

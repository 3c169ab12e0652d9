"""The ``r5dgs`` command: demo, train, masks, associate, bake, import, evaluate, report, bench, export, info, check,
objects, lookup, query, name, config, warm-up.

Modules: `parser` defines the arguments, `runs` and its neighbours run the commands, `exit_status` maps errors.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any

from .. import errors, terminal
from . import exit_status, export, parser, runs
from . import options as cli_options
from .exit_status import ExitStatus


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status (`ExitStatus`)."""
    with terminal.safe_output():
        args = parser.parser().parse_args(arguments)
        try:
            return _RUN[args.command](args) or ExitStatus.SUCCESS
        except BaseException as error:
            if isinstance(error, SystemExit | GeneratorExit):
                raise
            return _explain(error, args)


def _explain(error: BaseException, args: argparse.Namespace) -> ExitStatus:
    """Print the error for the user; returns the exit status."""
    status = exit_status.of(error)
    if isinstance(error, BrokenPipeError):  # the reader of our output is gone; discard the rest
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    elif status == ExitStatus.DEFECT:
        traceback.print_exception(error)
        print("r5dgs: this is a defect of R5DGS; please report it with the lines above", file=sys.stderr)
    elif status == ExitStatus.USAGE:
        args.parser_of.print_usage(sys.stderr)
        print(f"{args.parser_of.prog}: error: {terminal.printable(str(error))}", file=sys.stderr)
    else:
        remedy = "; check the path, its permissions and the free disk space" if isinstance(error, OSError) else ""
        print(f"r5dgs: {terminal.printable(str(error)) or 'stopped'}{remedy}", file=sys.stderr)
    return status


def _demo(args: argparse.Namespace) -> None:
    from .demo import run_demo

    run_demo(args.out, **_training(args))


def _train(args: argparse.Namespace) -> None:
    runs.run_train(args.data, args.out, **_training(args))


def _training(args: argparse.Namespace) -> dict[str, Any]:
    return {
        "config_path": args.config,
        "overrides": cli_options.overrides(args),
        "preset": args.preset,
        "resume": args.resume,
        "overwrite": args.overwrite,
        "threads": args.threads,
        "progress_kind": args.progress,
    }


def _masks(args: argparse.Namespace) -> None:
    from . import masks

    names = ("backend", "model", "source", "out", "key_frames", "points", "score", "stability", "max_area")
    options = {name: getattr(args, name) for name in (*names, "device", "unknown", "overwrite")}
    masks.run_masks(args.data, **options, progress_kind=args.progress)


def _associate(args: argparse.Namespace) -> None:
    from . import associate

    options = {"masks": args.masks, "out": args.out, "threads": args.threads, "progress_kind": args.progress}
    associate.run_associate(args.target, args.data, **options)


def _bake(args: argparse.Namespace) -> None:
    options = {"with_needs": args.needs, "threads": args.threads, "progress_kind": args.progress}
    runs.run_bake(args.run, args.out, args.data, cli_options.overrides(args), **options)


def _import(args: argparse.Namespace) -> None:
    names = ("iteration", "data", "knots", "t_max", "world", "still")
    options = {name: getattr(args, name) for name in names}
    runs.run_import(args.run, args.out, progress_kind=args.progress, **options)


def _evaluate(args: argparse.Namespace) -> None:
    options = {"modes": args.mode or ["rigid"], "json_path": args.json, "threads": args.threads}
    runs.run_evaluate(args.target, args.data, **options, progress_kind=args.progress)


def _report(args: argparse.Namespace) -> ExitStatus | None:
    measured = (args.target, args.out, args.tasks, args.splits, args.repeats)
    if args.stability and any(given is not None for given in measured):
        raise errors.UsageError("report --stability: needs no scene; takes --json FILE alone")
    if args.json is not None and not args.stability:
        raise errors.UsageError("report --json: is for --stability; a report's JSON goes to --out DIR/report.json")
    if args.stability:
        passed = runs.run_stability(args.json, threads=args.threads, progress_kind=args.progress)
        return None if passed else ExitStatus.NEGATIVE
    if args.target is None or args.out is None:
        raise errors.UsageError("report: expected RUN|SCENE and --out DIR, or --stability")
    options = {"tasks": args.tasks, "splits": args.splits, "rounds": args.repeats, "clock": args.clock}
    options |= {"threads": args.threads, "progress_kind": args.progress}
    runs.run_report(args.target, args.data, args.out, **options)
    return None


def _bench(args: argparse.Namespace) -> None:
    from . import bench

    bench.run_bench(
        args.scenes,
        args.out,
        variants=args.variants,
        seeds=args.seeds,
        modes=args.modes,
        preset=args.preset,
        config_path=args.config,
        overrides=cli_options.overrides(args),
        remeasure=args.remeasure,
        threads=args.threads,
        progress_kind=args.progress,
    )


def _check(args: argparse.Namespace) -> ExitStatus | None:
    from . import check

    return None if check.run_check(args.target, as_json=args.json) else ExitStatus.NEGATIVE


def _info(args: argparse.Namespace) -> None:
    from . import info

    info.run_info(args.file, with_needs=args.needs, as_json=args.json)


def _objects(args: argparse.Namespace) -> None:
    from . import objects

    objects.run_objects(args.target, args.data, legend=args.legend, as_json=args.json, **_picture(args))


def _lookup(args: argparse.Namespace) -> None:
    from . import language

    options = {"out": args.out, "captions": args.captions, "words": args.words, "threads": args.threads}
    language.run_lookup(args.file, args.encoder, **options, progress_kind=args.progress)


def _query(args: argparse.Namespace) -> ExitStatus | None:
    from . import objects

    options = {"encoder": args.encoder, "threshold": args.threshold, "as_json": args.json}
    picture = {"render": args.render, "context": args.context, **_picture(args)}
    found = objects.run_query(args.file, args.text, options, **picture)
    return None if found else ExitStatus.NEGATIVE


def _name(args: argparse.Namespace) -> None:
    from . import language

    language.run_name(args.file, args.object, args.name, aliases=args.alias, caption=args.caption)


def _config(args: argparse.Namespace) -> None:
    from . import config

    if args.user is not None:
        config.run_user_config(args.user, as_json=args.json)
    else:
        config.run_config(args.target, as_json=args.json)


def _warm_up(args: argparse.Namespace) -> None:
    runs.run_warm_up(progress_kind=args.progress)


def _picture(args: argparse.Namespace) -> dict[str, Any]:
    return {"camera": args.camera, "t": args.time, "mode": args.mode, "size": args.size, "threads": args.threads}


_RUN: dict[str, Callable[[argparse.Namespace], ExitStatus | None]] = {
    "demo": _demo,
    "train": _train,
    "masks": _masks,
    "associate": _associate,
    "bake": _bake,
    "import": _import,
    "evaluate": _evaluate,
    "report": _report,
    "bench": _bench,
    "export": export.run,
    "info": _info,
    "check": _check,
    "objects": _objects,
    "lookup": _lookup,
    "query": _query,
    "name": _name,
    "config": _config,
    "warm-up": _warm_up,
}

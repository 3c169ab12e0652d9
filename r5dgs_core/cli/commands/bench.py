"""The command ``r5dgs bench``: check the arguments, then train and measure."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ... import errors, input_paths
from ...bench.variants import DEFAULT_VARIANTS, VARIANTS
from ...config import config
from ...playback import modes as playback_modes
from .. import inputs, options

NAME = "bench"
SHORT = "train variants on scenes and write the paper's tables"
LONG = "Train variants of the method on data sets, measure each in every playback mode, and write the paper's tables."
EXAMPLE = "DATA1 DATA2 --out tables --seeds 0 1 2"
PAGE = "user/bench.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="data set folders")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder for runs and tables")
    some, usual = ", ".join(VARIANTS), " ".join(DEFAULT_VARIANTS)
    p.add_argument("--variants", nargs="+", metavar="NAME", help=f"variants to train, of {some} (default: {usual})")
    seeds = "random seeds, one run for each (default: 0)"
    p.add_argument("--seeds", type=options.at_least(0), nargs="+", default=[0], metavar="N", help=seeds)
    played = f"playback modes to measure, of {', '.join(playback_modes.every())} (default: one of each base)"
    p.add_argument("--modes", nargs="+", metavar="MODE", help=played)
    p.add_argument("--remeasure", action="store_true", help="bake and measure finished runs again")
    options.add_lpips(p)
    options.add_settings(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_bench(
        args.scenes,
        args.out,
        variants=args.variants,
        modes=args.modes,
        remeasure=args.remeasure,
        threads=args.threads,
        progress_kind=args.progress,
        seeds=args.seeds,
        lpips=args.lpips,
        preset=args.preset,
        config_path=args.config,
        overrides=[*options.overrides(args), *([] if args.device is None else [f"train.device={args.device}"])],
    )


def run_bench(
    scenes: Sequence[Path],
    out: Path,
    *,
    variants: Sequence[str] | None,
    modes: Sequence[str] | None,
    threads: int | None = None,
    remeasure: bool = False,
    lpips: Sequence[Path] | None = None,
    progress_kind: str = "auto",
    **plan: Any,
) -> dict[str, Any]:
    """Train variants on scenes and write the paper's tables (see `bench.benchmark.run_bench`).

    Args:
        scenes: Data sets.
        out: Output folder for runs and tables.
        variants: Names from `bench.variants.VARIANTS`; the default variants if None.
        modes: Playback modes; one per base if None.
        threads: Threads of the kernels; see `options.use_threads`.
        remeasure: Bake and measure finished runs again.
        lpips: Files of the weights of LPIPS; those of the user's settings if None.
        progress_kind: Form of progress output (`progress.make`).
        **plan: Other fields of `bench.cases.BenchmarkRequest`.

    Returns:
        The content of ``bench.json`` (docs/user/bench.md).
    """
    variants, modes = variants or DEFAULT_VARIANTS, modes or playback_modes.MODES
    _check_names("--variants", variants, tuple(VARIANTS))
    _check_names("--modes", modes, playback_modes.every())
    config.load(plan["config_path"], plan["overrides"], plan["preset"])
    for scene in scenes:
        inputs.check_dataset(scene)
    input_paths.check_output_folder("--out", out)
    plan["lpips"] = options.lpips_files(lpips)
    from ...bench import benchmark, cases

    options.use_threads(threads)
    plan |= {"overrides": tuple(plan["overrides"]), "seeds": tuple(plan["seeds"])}
    work = cases.BenchmarkRequest(scenes=tuple(scenes), out=out, variants=tuple(variants), modes=tuple(modes), **plan)
    return benchmark.run_bench(work, remeasure=remeasure, progress_kind=progress_kind)


def _check_names(option: str, given: Sequence[str], known: Sequence[str]) -> None:
    """Raise UsageError if a name is unknown."""
    for name in given:
        if name not in known:
            raise errors.UsageError(f"{option} {name}: expected one or more of {', '.join(known)}")

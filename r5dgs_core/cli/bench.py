"""The command ``r5dgs bench``: check the arguments, then train and measure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import errors, input_paths
from ..bench import variants as kinds
from ..config import config as configs
from ..playback import modes as scene_modes
from . import runs


def run_bench(
    scenes: Sequence[Path],
    out: Path,
    *,
    variants: Sequence[str] | None,
    modes: Sequence[str] | None,
    threads: int | None = None,
    remeasure: bool = False,
    progress_kind: str = "auto",
    **options: Any,
) -> dict[str, Any]:
    """Train variants on scenes and write the paper's tables (see `bench.benchmark.run_bench`).

    Args:
    scenes: Data sets.
    out: Output folder for runs and tables.
    variants: Names from `bench.variants.VARIANTS`; the default variants if None.
    modes: Playback modes; one per base if None.
    threads: Threads of the kernels; see `runs.use_threads`.
    remeasure: Bake and measure finished runs again.
    progress_kind: Form of progress output (`progress.make`).
    **options: Other fields of `bench.cases.Plan`.

    Returns:
        The content of ``bench.json`` (docs/user/bench.md).
    """
    variants, modes = variants or kinds.DEFAULT_VARIANTS, modes or scene_modes.MODES
    for option, given, known in (
        ("--variants", variants, tuple(kinds.VARIANTS)),
        ("--modes", modes, scene_modes.every()),
    ):
        for name in given:
            if name not in known:
                raise errors.UsageError(f"{option} {name}: expected some of {', '.join(known)}")
    configs.load(options["config_path"], options["overrides"], options["preset"])
    for scene in scenes:
        runs.check_dataset(scene)
    input_paths.check_output_folder("--out", out)
    from ..bench import benchmark, cases

    runs.use_threads(threads)
    options = {**options, "overrides": tuple(options["overrides"]), "seeds": tuple(options["seeds"])}
    plan = cases.Plan(scenes=tuple(scenes), out=out, variants=tuple(variants), modes=tuple(modes), **options)
    return benchmark.run_bench(plan, remeasure=remeasure, progress_kind=progress_kind)

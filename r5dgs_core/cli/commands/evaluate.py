"""The command ``r5dgs evaluate``: measure a run or scene on held-out views."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ... import errors, folder_lock, input_paths, terminal
from ...playback import modes
from .. import inputs, options

NAME = "evaluate"
SHORT = "measure a run or scene on held-out views"
LONG = "Render the held-out views of a run or scene, compare them with the images, and write evaluation.json."
EXAMPLE = "RUN --mode rigid --mode standard"
PAGE = "reference/evaluation.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("target", type=Path, help="run folder or .r5dgs file")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    kinds = f"playback mode, one of {', '.join(modes.every())} (default: rigid); may be repeated"
    p.add_argument("--mode", action="append", metavar="MODE", help=kinds)
    aligned = "align the held-out cameras to the scene for psnr_aligned (default: if training has refined its cameras)"
    p.add_argument("--align", action="store_true", default=None, help=aligned)
    p.add_argument("--json", type=Path, metavar="FILE", help="file to write instead of evaluation.json")
    options.add_lpips(p)
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"modes": args.mode or ["rigid"], "align": args.align, "json_path": args.json, "threads": args.threads}
    run_evaluate(args.target, args.data, **given, lpips=args.lpips, progress_kind=args.progress)


@folder_lock.writes("json_path", "target")
def run_evaluate(
    target: Path,
    data: Path | None,
    *,
    modes: list[str],
    json_path: Path | None,
    align: bool | None = None,
    lpips: Sequence[Path] | None = None,
    threads: int | None = None,
    progress_kind: str = "none",
) -> dict[str, Any]:
    """Measure a run or scene file on the held-out views of its data set, and write ``evaluation.json`` beside it.

    Args:
        target: Run folder or ``.r5dgs`` file.
        data: Data set; the one that the run was trained on if None.
        modes: Playback modes.
        json_path: File to write instead.
        align: As for `evaluate.evaluate`.
        lpips: Files of the weights of LPIPS; those of the user's settings if None.
        threads: Threads of the kernels; see `options.use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The evaluation, in the form of ``evaluation.json``.
    """
    _check(target, data, modes, json_path)
    weights = options.lpips_network(options.lpips_files(lpips))

    from ...evaluation import evaluate, evaluation_table
    from ...progress import make
    from ...scene import predictability
    from ...train import run_folder

    options.use_threads(threads)
    default = target / run_folder.EVALUATION_FILE if target.is_dir() else target.with_suffix(".evaluation.json")
    with make(progress_kind) as progress:
        progress({"event": "prepare", "text": "the scene"})
        scene, dataset = inputs.open_target(target, data)
        assert dataset is not None
        for mode in modes:
            inputs.check_mode(mode, scene, target)
        result = evaluate.evaluate(
            scene,
            dataset,
            modes=modes,
            train=scene.provenance.get("train"),
            align=align,
            perceptual=weights,
            progress=lambda done, total: progress({"event": "evaluate", "done": done, "total": total}),
        )
    if progress_kind != "json":
        terminal.console().print(evaluation_table.make(result))
        terminal.print_lines(predictability.warnings(scene))
    path = evaluate.write(result, json_path or default)
    if progress_kind != "json":
        print(f"written: {path}")
    return result


def _check(target: Path, data: Path | None, modes: Sequence[str], json_path: Path | None) -> None:
    """Raise R5dgsError if arguments of `run_evaluate` cannot be used."""
    for mode in modes:
        inputs.check_mode(mode)
    inputs.check_target(target, data)
    input_paths.check_output("--json", json_path)
    if data is None and not target.is_dir():
        raise errors.UsageError(f"{target}: a scene file requires a data set: r5dgs evaluate {target} --data DIR")

"""The command ``r5dgs train``: train on a data set and write a run folder."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ... import terminal
from .. import inputs, options

NAME = "train"
SHORT = "train on a data set and write a run folder"
LONG = "Train 4D Gaussians from posed images and object masks. Use --resume to continue a stopped run."
EXAMPLE = "DATA --out RUN"
PAGE = "user/training.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("data", type=Path, help="data set folder: transforms_train.json, or images and sparse/")
    p.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder to write")
    shown = "masks of the training views (default: DATA/object_mask); 'none' trains without masks"
    p.add_argument("--masks", metavar="FOLDER", help=shown)
    options.add_training(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = options.training(args)
    if args.masks is not None:
        masks = args.masks if args.masks == "none" else Path(args.masks).resolve()
        given["overrides"].append(f"data.masks={masks}")
    run_train(args.data, args.out, **given)


def run_train(
    data: Path,
    out: Path,
    *,
    config_path: Path | None,
    overrides: Sequence[str],
    preset: str | None = None,
    resume: bool,
    overwrite: bool,
    device: str | None = None,
    threads: int | None = None,
    progress_kind: str,
) -> None:
    """Train a run folder from a data set (see `train.run.train`), and name objects whose motion is not predictable."""
    from ...progress import make

    settings = options.training_settings(out, config_path, overrides, preset=preset, resume=resume)
    inputs.check_dataset(data)
    from ...bake import quick_fit
    from ...scene import camera_correction, predictability
    from ...train import interrupt, run

    options.use_threads(threads)
    with make(progress_kind) as progress:
        trained = run.train(data, out, settings, resume=resume, overwrite=overwrite, device=device, progress=progress)
        with interrupt.at_once(f"{out} is trained; stopped while its motion was fitted"):
            progress({"event": "prepare", "text": "motion past the last observed time"})
            scene = quick_fit.scene_of(trained)
        lines = predictability.warnings(scene)
        refined = [f"cameras: {text}" for text in camera_correction.sizes(scene.provenance["cameras"]).values()]
        if progress_kind == "json":
            for event, texts in (("cameras", refined), ("warning", lines)):
                for line in texts:
                    progress({"event": event, "text": line})
    if progress_kind == "auto":
        terminal.print_lines([*refined, *lines])

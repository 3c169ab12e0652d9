"""The command ``r5dgs train``: train on a data set and write a run folder."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, input_paths, terminal
from .. import exit_status, inputs, options
from ..exit_status import ExitStatus
from . import bake

if TYPE_CHECKING:
    from ...scene.scene import Scene
    from ...train.workers import Workers

NAME = "train"
SHORT = "train on a data set and write a run folder"
LONG = "Train 4D Gaussians from posed images and object masks. Use --resume to continue a stopped run."
EXAMPLE = "DATA --out RUN"
PAGE = "user/training.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("data", type=Path, help="data set folder: transforms_train.json, or images and sparse/")
    p.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder to write")
    p.add_argument("--scene", type=Path, metavar="FILE.r5dgs", help="also bake the run to this scene file")
    shown = "masks of the training views (default: DATA/object_mask); 'none' trains without masks"
    p.add_argument("--masks", metavar="FOLDER", help=shown)
    options.add_training(p)


def run(args: argparse.Namespace) -> ExitStatus | None:
    """Run the command, in this process or together with others that ``torch.distributed.run`` has started."""
    given = {**options.training(args), "scene": args.scene}
    if args.masks is not None:
        masks = args.masks if args.masks == "none" else Path(args.masks).resolve()
        given["overrides"].append(f"data.masks={masks}")
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or "RANK" not in os.environ:
        run_train(args.data, args.out, **given)
        return None
    from ...train import workers

    group = workers.ALONE
    try:
        with workers.joined() as group:
            run_together(args.data, args.out, group, **given)
    except (errors.R5dgsError, KeyboardInterrupt) as error:
        if group.explains(error):
            raise
        return exit_status.status_of(error)
    return None


def run_together(data: Path, out: Path, group: Workers, **given: Any) -> None:
    """Train a run folder with other processes: lead them (see `run_train`), or take the steps of the leading one.

    Raises:
        UsageError: The processes are restarted without continuing the run.
        ConfigError: All processes would use the same GPU.
    """
    from ...raster import thread_pool
    from ...train import follow, workers

    if workers.may_restart() and not given["resume"]:
        raise errors.UsageError("--max-restarts: add --resume, so that a restart continues from the last checkpoint")
    if ":" in (given["device"] or ""):
        raise errors.ConfigError(f"--device {given['device']}: each process takes a GPU of its own; use --device cuda")
    if given["threads"] is None and "NUMBA_NUM_THREADS" not in os.environ:
        given["threads"] = max(1, thread_pool.threads() // workers.on_this_machine())
    if group.leads:
        run_train(data, out, **given, workers=group)
    else:
        options.use_threads(given["threads"])
        follow.follow(data, group)


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
    scene: Path | None = None,
    workers: Workers | None = None,
) -> None:
    """Train a run folder from a data set (see `train.run.train`), and name objects whose motion is not predictable.

    ``scene`` is the scene file to which the run is then baked (see `bake.run_bake`), if any. Otherwise, the motion is
    fitted without the images for these names only.
    """
    if scene is not None:
        input_paths.check_scene_output(scene, made=out)
    count = 1 if workers is None else workers.count
    settings = options.training_settings(out, config_path, overrides, preset=preset, resume=resume, processes=count)
    inputs.check_dataset(data)
    from ...bake import quick_fit
    from ...progress import make
    from ...train import interrupt, run
    from ...train.workers import ALONE

    options.use_threads(threads)
    fitted = None
    with make(progress_kind) as progress:
        trained = run.train(
            data,
            out,
            settings,
            resume=resume,
            overwrite=overwrite,
            device=device,
            progress=progress,
            workers=workers or ALONE,
        )
        if scene is None:
            with interrupt.at_once(f"{out} is trained; stopped while its motion was fitted"):
                progress({"event": "prepare", "text": "motion past the last observed time"})
                fitted = quick_fit.scene_of(trained)
    if fitted is not None:
        _report(fitted, progress_kind, summarized=False)
    elif scene is not None:
        baking = f"r5dgs bake {shlex.quote(str(out))} --out {shlex.quote(str(scene))}"
        with interrupt.at_once(f"{out} is trained; stopped before {scene} was written. To write it: {baking}"):
            baked = bake.run_bake(out, scene, None, threads=threads, progress_kind=progress_kind)
        _report(baked, progress_kind, summarized=True)


def _report(fitted: Scene, progress_kind: str, *, summarized: bool) -> None:
    """Print the refinement of the cameras and what is not predictable, unless the summary of a bake has."""
    from ...progress import make
    from ...scene import camera_correction, predictability

    lines = predictability.warnings(fitted)
    refined = [f"cameras: {text}" for text in camera_correction.sizes(fitted.provenance.get("cameras", {})).values()]
    if progress_kind == "json":
        with make(progress_kind) as progress:
            for event, texts in (("cameras", refined), ("warning", lines)):
                for line in texts:
                    progress({"event": event, "text": line})
    if progress_kind == "auto" and not summarized:
        terminal.print_lines([*refined, *lines])

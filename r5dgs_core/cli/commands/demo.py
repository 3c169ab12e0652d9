"""The command ``r5dgs demo``: train, bake and evaluate the bundled data set."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, folder_lock, strict_json, terminal
from ...time_left import Phase
from .. import options

if TYPE_CHECKING:
    from ...config.config import Config
    from ...data.dataset import Dataset
    from ...scene.scene import Scene
    from ...train.run_folder import Run

NAME = "demo"
SHORT = "train, bake and evaluate the bundled data set"
LONG = (
    "Train the bundled data set, bake a scene file, evaluate it on held-out views and draw a contact sheet.\n"
    "Takes two to four minutes on two cores."
)
EXAMPLE = "--out demo"
PAGE = "user/training.md"

DATASET = "tabletop"
# Mean PSNR of a normal run, dB; the test split lies past t_max. Rounding differences between processors change val as
# much as another seed does: seeds 0, 1 and 2 gave 43.1, 42.7 and 42.5 dB on one machine.
EXPECTED = {"val": 42.0, "test": 37.0}
AFTER = (Phase("bake", 1, 150), Phase("evaluate", 60, 4))  # phases after training, with measured costs


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="run folder (default: demo)")
    options.add_training(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_demo(args.out, **options.training(args))


def bundled_data() -> Path:
    """Return the folder of the bundled data set, beside the sources or inside the installed package.

    Raises:
        DatasetError: It is missing in both places.
    """
    here = Path(__file__).resolve().parents[2]
    for candidate in (here / "examples" / DATASET, here.parent / "examples" / DATASET):
        if (candidate / "transforms_train.json").exists():
            return candidate
    raise errors.DatasetError(
        f"the bundled data set 'examples/{DATASET}' is missing; install r5dgs again from its source"
    )


def run_demo(
    out: Path,
    *,
    config_path: Path | None,
    overrides: Sequence[str],
    preset: str | None = None,
    resume: bool,
    overwrite: bool = False,
    device: str | None = None,
    threads: int | None = None,
    progress_kind: str,
) -> dict[str, Any]:
    """Train, bake and evaluate the bundled data set.

    Writes the run, ``demo.r5dgs``, ``evaluation.json`` and ``contact_sheet.png`` into ``out``, and prints the table. A
    previous demo in ``out`` is replaced unless ``resume`` is given; any other run requires ``overwrite``.

    Returns:
        The evaluation.
    """
    began, data = time.monotonic(), bundled_data()
    settings = options.training_settings(out, config_path, overrides, preset=preset, resume=resume)

    from ...evaluation import contact_sheet, evaluate, evaluation_table
    from ...progress import make
    from ...scene import predictability
    from ...train import interrupt, run, run_folder

    options.use_threads(threads)
    resume_command = shlex.join(["r5dgs", "demo", "--out", str(out), "--resume"])
    with make(progress_kind) as progress:
        progress.estimate.add(*AFTER)
        trained = run.train(
            data,
            out,
            settings,
            resume=resume,
            overwrite=overwrite or _is_demo(out / run_folder.RUN_FILE),
            device=device,
            resume_command=resume_command,
            progress=progress,
        )
        with interrupt.at_once(f"stopped after training; continue with: {resume_command}"), folder_lock.hold(out):
            scene_path = out / "demo.r5dgs"
            scene, dataset, result = _bake_and_evaluate(trained, data, scene_path, progress)
    if progress_kind != "json":
        terminal.console().print(evaluation_table.make(result))
        terminal.print_lines(predictability.warnings(scene))
    stopped = interrupt.at_once(f"stopped before the contact sheet; continue with: {resume_command}")
    with make(progress_kind) as progress, stopped, folder_lock.hold(out):
        json_path = evaluate.write(result, out / run_folder.EVALUATION_FILE)
        progress({"event": "sheet", "text": "contact sheet"})
        sheet = contact_sheet.write(scene, dataset, out / "contact_sheet.png")
        if progress_kind == "json":
            progress({"event": "written", "scene": str(scene_path), "table": str(json_path), "sheet": str(sheet)})
    if progress_kind != "json":
        print(f"scene:         {scene_path}\ncontact sheet: {sheet}\ntable:         {json_path}")
        print(f"{time.monotonic() - began:.0f} s in all; open the scene in Blender: File > Import > R5DGS scene")
        terminal.print_lines([expectation()] if has_expectation(trained.config) else [])
    return result


def _bake_and_evaluate(trained: Run, data: Path, path: Path, progress: Any) -> tuple[Scene, Dataset, dict[str, Any]]:
    """Write the scene file of a run; returns the scene, its data set and the evaluation."""
    from ...bake import bake
    from ...data import dataset as datasets
    from ...evaluation import evaluate
    from ...scene import scene_file

    progress({"event": "bake", "text": "motion models and scene file"})
    dataset = datasets.read(data)
    scene = bake.bake(trained, dataset)
    scene_file.write(scene, path)
    progress.estimate.finish("bake")
    result = evaluate.evaluate(
        scene,
        dataset,
        train=scene.provenance["train"],
        progress=lambda done, total: progress({"event": "evaluate", "done": done, "total": total}),
    )
    return scene, dataset, result


def has_expectation(settings: Config) -> bool:
    """Return True if a run has the settings of `EXPECTED`, whose seed and device are arbitrary."""
    from ...config.config import Config

    return {*settings.differences(Config())} <= {"train.seed", "train.device"}


def expectation() -> str:
    """Return the line with the PSNR of a normal run."""
    return f"expected about {EXPECTED['val']:g} / {EXPECTED['test']:g} dB (val / test)"


def _is_demo(run_file: Path) -> bool:
    """Return True if the run was trained on the bundled data set, of this or an earlier version."""
    try:
        return Path(strict_json.read(run_file, errors.CheckpointError)["dataset"]).name == DATASET
    except (errors.CheckpointError, KeyError, TypeError):
        return False

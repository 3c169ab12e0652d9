"""Run of a benchmark from its plan to its tables; finished cases are kept and interrupted ones are resumed."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch

from .. import terminal
from ..bake import bake
from ..data import dataset as datasets
from ..errors import CheckpointError, R5dgsError, TrainingError
from ..evaluation import evaluate, lpips
from ..playback import scene_player
from ..progress import make as make_progress
from ..render import machine as machines
from ..scene import scene_file
from ..train import checkpoint, interrupt, run_folder, warm_up
from . import cases, playback_speed, plot, process, tables
from .cases import BenchmarkRequest, Case

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]
RESULT_FILE, TABLES_FILE, PLOT_FILE = "bench.json", "tables.md", "error_against_time.png"
SPLITS = ("test", "val")


def run_bench(plan: BenchmarkRequest, *, remeasure: bool = False, progress_kind: str = "auto") -> dict[str, Any]:
    """Train, bake and measure every case of a plan, and write the results after each of them.

    Writes the files of each case (`cases`), `RESULT_FILE`, `TABLES_FILE` and `PLOT_FILE` into ``plan.out``.

    Args:
        remeasure: Bake and measure finished runs again.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The content of `RESULT_FILE` (docs/user/bench.md).

    Raises:
        ConfigError, DatasetError, CheckpointError: Errors of `cases.make`, before training starts.
        TrainingError: Some cases failed; all others are finished and written.
        Interrupted: SIGINT or SIGTERM was received; the same command resumes the benchmark.
    """
    planned = cases.make(plan)
    if plan.lpips:
        lpips.load(plan.lpips)  # reports damaged files before hours of training
    records: list[dict[str, Any]] = []
    failures: list[dict[str, Any]] = []
    result: dict[str, Any] = {}
    with make_progress(progress_kind) as progress, interrupt.at_once("stopped; repeat the same command to continue"):
        progress({"event": "prepare", "text": "kernels"})
        warm_up.warm_up()
        for index, case in enumerate(planned):
            progress({"event": "case", "text": f"{case.title} ({index + 1} of {len(planned)})"})
            try:
                records += run_case(plan, case, remeasure, progress)
            except Exception as error:  # a failed case must not stop the others
                if not isinstance(error, R5dgsError):
                    log.exception("%s", case.title)
                text = str(error) if isinstance(error, R5dgsError) else f"{type(error).__name__}: {error}"
                failures.append({**case.names, "error": text})
                progress({"event": "failed", "text": f"{case.title}: {text}"})
            result = _write(plan, records, failures)
        if progress_kind == "json":
            progress({"event": "written", "table": str(plan.out / RESULT_FILE)})
    if progress_kind != "json":
        _show(plan, result)
    if failures:
        raise TrainingError(
            f"{len(failures)} of {len(planned)} runs failed, the first one {failures[0]['scene']}, "
            f"{failures[0]['variant']}, seed {failures[0]['seed']}: {failures[0]['error']}; "
            f"see {plan.out / TABLES_FILE}, and repeat the same command to try them again"
        )
    return result


def run_case(plan: BenchmarkRequest, case: Case, remeasure: bool, progress: Progress) -> list[dict[str, Any]]:
    """Finish the training and the measurements of a case; returns its records, one per mode."""
    if not cases.is_finished(case):
        _train(plan, case, progress)
    record = cases.read_record(case)
    stamp = _stamp(case)
    measured = record.get("measured") or {}
    if remeasure or measured.get("checkpoint") != stamp:
        measured = {"checkpoint": stamp, "modes": {}}
    lacking = [mode for mode in plan.modes if mode not in measured["modes"] and mode not in measured.get("absent", [])]
    if lacking:
        measured = _measure(plan, case, measured, lacking, progress)
        cases.write_record(case, {**record, "measured": measured})
    shared = {
        **case.names,
        "gaussians": measured["gaussians"],
        "iterations": measured["iterations"],
        "trained_on": measured.get("trained_on"),
        "train": cases.cost(record["sittings"]),
    }
    shared["machine"] = None  # default for records of earlier versions, which lack the machine
    return [{**shared, "mode": mode, **measured["modes"][mode]} for mode in plan.modes if mode in measured["modes"]]


def _train(plan: BenchmarkRequest, case: Case, progress: Progress) -> None:
    """Train a case in a separate process, from its last checkpoint if it has one."""
    record = cases.read_record(case)
    arguments = ["train", str(case.root), "--out", str(case.run)]
    if (case.run / run_folder.RUN_FILE).exists():
        arguments.append("--resume")
    else:
        record = {"sittings": []}
        arguments += ["--preset", plan.preset] if plan.preset else []
        arguments += ["--config", str(plan.config_path)] if plan.config_path else []
        arguments += [text for override in case.overrides for text in ("--set", override)]
    before = record["sittings"]
    # Write a record of unknown cost first, so that a killed session is recorded.
    cases.write_record(case, {"sittings": [*before, {"status": None}]})
    log_path = case.beside(".log")

    def note(sitting: process.EndedProcess) -> None:
        values = {key: getattr(sitting, key) for key in ("status", *cases.COSTS)}
        cases.write_record(case, {"sittings": [*before, values]})

    try:
        sitting = process.run(arguments, log_path, progress, note)
    except OSError as error:
        raise CheckpointError(f"{log_path}: training cannot be started or followed: {error}") from error
    if sitting.status == process.STOPPED:
        raise KeyboardInterrupt  # training was stopped from outside, which stops the benchmark too
    if sitting.status != 0:
        raise TrainingError(process.reason(sitting))


def _stamp(case: Case) -> list[int]:
    """Return size and modification time of the newest checkpoint, which identify it."""
    newest = checkpoint.newest_file(case.run)
    assert newest is not None  # the case is finished
    found = newest.stat()
    return [found.st_size, found.st_mtime_ns]


def _measure(
    plan: BenchmarkRequest, case: Case, measured: dict[str, Any], lacking: Sequence[str], progress: Progress
) -> dict[str, Any]:
    """Bake a run, write its scene, and measure the lacking modes that the scene supports."""
    progress({"event": "bake", "text": case.title})
    run = run_folder.open_run(case.run)
    dataset = datasets.read(case.root, run.config.data.masks, run.config.data.min_registered)
    if dataset.digest != run.digest:
        raise CheckpointError(f"{case.run}: was trained on other data than {case.root} now holds; restore the data")
    scene = bake.bake(run, dataset)
    scene_file.write(scene, case.beside(".r5dgs"))
    there = scene_player.modes(scene)
    modes = [mode for mode in lacking if mode in there]
    evaluation = evaluate.evaluate(
        scene,
        dataset,
        modes=modes,
        splits=SPLITS,
        perceptual=lpips.load(plan.lpips) if plan.lpips else None,
        progress=lambda done, total: progress({"event": "evaluate", "done": done, "total": total}),
    )
    played = playback_speed.measure(scene, dataset.test or dataset.val, modes)
    found = {
        mode: {
            "splits": {split: evaluation["splits"][split][mode] for split in SPLITS},
            "playback": played[mode],
            "machine": machine(),
        }
        for mode in modes
    }
    return {
        **measured,
        "gaussians": evaluation["train"]["gaussians"],
        "iterations": evaluation["train"]["iterations"],
        "objects": evaluation["objects"],
        "trained_on": {**run.platform, "torch_threads": run.config.train.threads, "versions": run.versions},
        "modes": {**measured["modes"], **found},
        "absent": [mode for mode in plan.modes if mode not in there],
    }


def _write(
    plan: BenchmarkRequest, records: Sequence[dict[str, Any]], failures: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Write result, tables and plot of the cases finished so far; returns the result."""
    result = {
        "machine": machine(),
        "settings": {
            "preset": plan.preset,
            "config": None if plan.config_path is None else str(plan.config_path),
            "set": list(plan.overrides),
        },
        "results": list(records),
        "failures": list(failures),
        "rows": tables.report_rows(records),
    }
    cases.write(plan.out / RESULT_FILE, json.dumps(result, indent=2))
    cases.write(plan.out / TABLES_FILE, tables.markdown(result))
    plot.write(records, plan.out / PLOT_FILE)
    return result


def _show(plan: BenchmarkRequest, result: dict[str, Any]) -> None:
    """Print the tables and the paths of the files."""

    for sheet in tables.sheets(result):
        table, console = tables.to_rich(sheet), terminal.console()
        wide = console.measure(table, options=console.options.update(width=1000)).maximum
        terminal.console(width=max(wide, console.width)).print(table)  # too wide is better than truncated
    print(f"tables: {plan.out / TABLES_FILE}\nresult: {plan.out / RESULT_FILE}\nplot:   {plan.out / PLOT_FILE}")


def machine() -> dict[str, Any]:
    """Describe the machine, threads and versions of this process."""
    return {**machines.describe(), "torch_threads": torch.get_num_threads(), "versions": machines.versions()}

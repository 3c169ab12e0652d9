"""Functions ``run_<name>`` of most ``r5dgs`` commands, which Python code can call without the command line."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import errors, folder_lock, input_paths, terminal
from ..config import config as configs
from ..playback import modes as scene_modes

if TYPE_CHECKING:
    from ..data.dataset import Dataset
    from ..scene.scene import Scene

log = logging.getLogger(__name__)


def run_train(
    data: Path,
    out: Path,
    *,
    config_path: Path | None,
    overrides: list[str],
    preset: str | None = None,
    resume: bool,
    overwrite: bool,
    threads: int | None = None,
    progress_kind: str,
) -> None:
    """Train a run folder from a data set (see `train.run.train`)."""
    from ..progress import make

    settings = training_settings(out, config_path, overrides, preset=preset, resume=resume)
    check_dataset(data)
    from ..train import run

    use_threads(threads)
    with make(progress_kind) as progress:
        run.train(data, out, settings, resume=resume, overwrite=overwrite, progress=progress)


def training_settings(
    folder: Path, config_path: Path | None, overrides: Sequence[str], *, preset: str | None, resume: bool
) -> configs.Config:
    """Return the configuration of a new run; a resumed run keeps its own.

    Raises:
        UsageError: A run is resumed with options that change its configuration.
        ConfigError: A key or value is invalid.
    """
    if resume and (config_path or overrides or preset) and (Path(folder) / input_paths.RUN_FILE).exists():
        raise errors.UsageError(
            "--resume continues with the configuration of the run; leave out --preset, --config, --set, --iterations, "
            "--seed and --max-gaussians"
        )
    return configs.load(config_path, tuple(overrides), preset)


def check_dataset(root: Path) -> None:
    """Raise `DatasetError` if a path is not a data set folder in a known layout."""
    from ..data.layouts import registry

    registry.check(root)


def use_threads(count: int | None) -> None:
    """Set the number of threads of the kernels; None keeps NUMBA_NUM_THREADS, or else all usable cores."""
    if count is not None:
        from ..raster import compilation

        compilation.set_threads(count)


@folder_lock.writes("out")
def run_bake(
    run_folder: Path,
    out: Path,
    data: Path | None,
    overrides: Sequence[str] = (),
    *,
    with_needs: bool = False,
    threads: int | None = None,
    progress_kind: str = "none",
) -> None:
    """Convert a run to a scene file (see `bake.bake.run_bake`) and print a summary, with the needs table if asked."""
    input_paths.check_scene_output(out)
    configs.require_needs(overrides)
    input_paths.check_run(run_folder)
    if data is not None:
        check_dataset(data)

    from ..bake import bake
    from ..evaluation import evaluation_table, scene_summary
    from ..progress import make

    use_threads(threads)
    with make(progress_kind) as progress:
        progress({"event": "bake", "text": "motion models and scene file"})
        scene = bake.run_bake(run_folder, out, data, overrides)
        if progress_kind == "json":
            progress({"event": "written", "scene": str(out)})
    if progress_kind == "json":
        return
    print(f"written: {terminal.printable(str(out))}\n{scene_summary.summary(scene, out)}")
    if with_needs:
        terminal.console().print(evaluation_table.needs(scene.needs))


@folder_lock.writes("out")
def run_import(run_folder: Path, out: Path, *, progress_kind: str = "none", **options: Any) -> None:
    """Convert a run folder of another program to a scene file (see `importing.importer.import_run`).

    Args:
        run_folder: Run folder of the other program.
        out: Scene file to write.
        progress_kind: Form of progress output (`progress.make`).
        **options: Fields of `importing.importer.Options`.
    """
    input_paths.check_scene_output(out)
    input_paths.check_foreign_run(run_folder)
    if options.get("data") is not None:
        check_dataset(options["data"])
    from ..importing import importer
    from ..progress import make
    from ..scene import scene_file

    chosen = importer.Options(**{name: value for name, value in options.items() if value is not None})
    with make(progress_kind) as progress:
        scene = importer.import_run(
            run_folder,
            chosen,
            lambda done, total: progress({"event": "import", "done": done, "total": total, "unit": "Gaussians"}),
        )
        scene_file.write(scene, out)
        if progress_kind == "json":
            progress({"event": "imported", "path": str(out), "gaussians": len(scene.gaussians.means)})
    if progress_kind != "json":
        count = sum(o.id > 0 for o in scene.objects)
        objects = "1 object" if count == 1 else f"{count} objects"
        print(f"{out}: {len(scene.gaussians.means)} Gaussians, {objects}, t_max {scene.t_max:g}")


@folder_lock.writes("json_path", "target")
def run_evaluate(
    target: Path,
    data: Path | None,
    *,
    modes: list[str],
    json_path: Path | None,
    threads: int | None = None,
    progress_kind: str = "none",
) -> dict[str, Any]:
    """Measure a run or scene file on the held-out views of its data set, and write ``evaluation.json`` beside it.

    Args:
        target: Run folder or ``.r5dgs`` file.
        data: Data set; the one that the run was trained on if None.
        modes: Playback modes.
        json_path: File to write instead.
        threads: Threads of the kernels; see `use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The evaluation, in the form of ``evaluation.json``.
    """
    for mode in modes:
        check_mode(mode)
    check_target(target, data)
    input_paths.check_output("--json", json_path)
    if data is None and not target.is_dir():
        raise errors.UsageError(f"{target}: a scene file requires a data set: r5dgs evaluate {target} --data DIR")

    from ..evaluation import evaluate, evaluation_table
    from ..progress import make
    from ..train import checkpoint

    use_threads(threads)
    default = target / checkpoint.EVALUATION_FILE if target.is_dir() else target.with_suffix(".evaluation.json")
    with make(progress_kind) as progress:
        progress({"event": "prepare", "text": "the scene"})
        scene, dataset = open_target(target, data)
        assert dataset is not None
        for mode in modes:
            check_mode(mode, scene, target)
        result = evaluate.evaluate(
            scene,
            dataset,
            modes=modes,
            train=scene.provenance.get("train"),
            progress=lambda done, total: progress({"event": "evaluate", "done": done, "total": total}),
        )
    path = json_path or default
    if progress_kind != "json":
        terminal.console().print(evaluation_table.make(result))
    evaluate.write(result, path)
    if progress_kind != "json":
        print(f"written: {path}")
    return result


def run_stability(json_path: Path | None = None, *, threads: int | None = None, progress_kind: str = "none") -> bool:
    """Run the stiff, extreme and degenerate cases on this installation and print the results.

    Args:
        json_path: JSON file of the results, or None.
        threads: Threads of the kernels; see `use_threads`.
        progress_kind: Form of progress output (`progress.make`); "json" prints no table.

    Returns:
        True if all cases passed.
    """
    input_paths.check_output("--json", json_path)

    from .. import stability
    from ..progress import make
    from ..stability import training

    use_threads(threads)
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


def open_target(target: Path, data: Path | None) -> tuple[Scene, Dataset | None]:
    """Return the scene of a run folder or scene file, and its data set; for a file, only if ``data`` is given."""
    from ..bake import bake
    from ..data import dataset as datasets
    from ..scene import scene_file
    from ..train import checkpoint

    if target.is_dir():
        run = checkpoint.open_run(target)
        dataset = datasets.read(run.data(data), run.config.data.masks, run.config.data.min_registered)
        scene, trained_on = bake.bake(run, dataset), run.digest
    else:
        scene = scene_file.read(target)
        dataset = None if data is None else datasets.read(data, min_registered=0.0)
        trained_on = scene.provenance.get("dataset_digest")
    if dataset is not None and trained_on is not None and trained_on != dataset.digest:
        log.warning("%s: differs from the data that %s was trained on; it is used anyway", dataset.root, target)
    return scene, None if dataset is None else dataset.relative_to(scene.origin)


def check_target(target: Path, data: Path | None) -> None:
    """Raise R5dgsError if the target is neither a run folder nor a file, or if ``data`` is not a data set."""
    input_paths.check_target(target)
    if data is not None:
        check_dataset(data)


def check_mode(mode: str, scene: Scene | None = None, place: object = "") -> None:
    """Raise UsageError for an unknown playback mode, or ConfigError if the scene at ``place`` has no data for it."""
    try:
        scene_modes.split(mode)
    except ValueError:
        raise errors.UsageError(f"--mode {mode}: expected one of {', '.join(scene_modes.every())}") from None
    if scene is None:
        return
    from ..playback import scene_player

    if not scene_player.available(scene, mode):
        raise errors.ConfigError(f"--mode {mode}: {place} has data for {', '.join(scene_player.modes(scene))} only")


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
        data: Data set; if None, the one that a run was trained on, and none for a file.
        out: Folder of ``report.json``, ``.csv``, ``.md`` and ``.png``.
        tasks: Tasks to measure; all if None.
        splits: Splits whose images are compared; "test" if None.
        rounds: Timing rounds; `error_vs_time.report.ROUNDS` if None.
        clock: "wall", or "cpu" for processor time.
        threads: Threads of the kernels; see `use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The report, in the form of ``report.json``.
    """
    check_target(target, data)
    input_paths.check_output_folder("--out", out)
    from ..error_vs_time import report, report_rows, tables
    from ..progress import make

    use_threads(threads)
    with make(progress_kind) as progress:
        progress({"event": "prepare", "text": "the scene"})
        scene, dataset = open_target(target, data)
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


def run_warm_up(*, progress_kind: str) -> dict[str, Any]:
    """Compile the rasterizing and training kernels, so that the first picture does not wait for them.

    Args:
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        ``seconds`` of run time, number of kernels ``compiled`` (0 if all were cached) and the cache ``folder`` (None if
        no folder can be written).
    """
    from ..progress import make

    try:
        from ..raster import compilation
        from ..train import warm_up
    except ImportError as error:
        raise errors.BackendError(f"warm-up: {sys.executable} lacks '{error.name}'; install r5dgs again") from error

    with make(progress_kind) as progress, compilation.telling(lambda text: progress({"event": "notice", "text": text})):
        seconds = warm_up.warm_up(lambda stage: progress({"event": "prepare", "text": stage}))
        folder = compilation.cache_folder()
        compiled = compilation.compiled()
        result = {"seconds": round(seconds, 2), "compiled": compiled, "folder": None if folder is None else str(folder)}
        if progress_kind == "json":
            progress({"event": "ready", **result})
    if progress_kind != "json":
        done = f"compiled {compiled} kernels in {seconds:.1f} s" if compiled else f"ready: loaded in {seconds:.1f} s"
        print(f"{done}; kept in {folder}" if folder else f"{done}; not kept, because no cache folder can be written")
    return result

"""What the sub-commands of ``r5dgs`` do: functions ``run_<name>`` that can be called without the command line."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import errors

if TYPE_CHECKING:
    from .data.dataset import Dataset
    from .scene.scene import Scene

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
    progress_kind: str,
) -> None:
    """Train a run folder from a data set (see `train.run.train`)."""
    from .progress import make
    from .train import run

    settings = run.settings(out, config_path, overrides, preset=preset, resume=resume)
    with make(progress_kind) as progress:
        run.train(data, out, settings, resume=resume, overwrite=overwrite, progress=progress)


def run_bake(run_folder: Path, out: Path, data: Path | None, overrides: Sequence[str] = ()) -> None:
    """Turn a run into a scene file (see `train.bake.run_bake`) and say what the scene needs."""
    from rich.console import Console

    from .report import table
    from .train import bake

    check_scene_name(out)
    scene = bake.run_bake(run_folder, out, data, overrides)
    _tell_scene(scene, out)
    Console().print(table.needs(scene.needs))


def run_import(run_folder: Path, out: Path, *, progress_kind: str = "none", **options: Any) -> None:
    """Turn a run folder that another program trained into a scene file (see `importing.importer.import_run`).

    Args:
        run_folder: The folder.
        out: The scene file to write.
        progress_kind: How progress is shown (`progress.make`).
        **options: The fields of `importing.importer.Options`.
    """
    from .importing import importer
    from .progress import make
    from .scene import scene_file

    check_scene_name(out)
    chosen = importer.Options(**{name: value for name, value in options.items() if value is not None})
    with make(progress_kind) as progress:
        scene = importer.import_run(
            run_folder,
            chosen,
            lambda done, total: progress({"event": "import", "done": done, "total": total, "unit": "Gaussians"}),
        )
        scene_file.write(scene, out)
        if progress_kind == "json":
            progress({"event": "imported", "path": str(out), "gaussians": len(scene.means)})
    if progress_kind != "json":
        _tell_scene(scene, out)


def check_scene_name(out: Path) -> None:
    """Refuse a place for a scene file that Blender would not find. Raises `SceneFileError`."""
    if out.is_dir():
        raise errors.SceneFileError(f"{out}: is a folder; name the file, for example {out / 'scene.r5dgs'}")
    if out.suffix.lower() != ".r5dgs":
        raise errors.SceneFileError(f"{out}: expected a name that ends in .r5dgs, which is what Blender looks for")


def _tell_scene(scene: Scene, out: Path) -> None:
    count = sum(o.id > 0 for o in scene.objects)
    objects = "1 object" if count == 1 else f"{count} objects"
    print(f"{out}: {len(scene.means)} Gaussians, {objects}, t_max {scene.t_max:g}")


def run_evaluate(
    target: Path, data: Path | None, *, modes: list[str], json_path: Path | None, progress_kind: str = "none"
) -> dict[str, Any]:
    """Measure a run or scene file on its data set's held-out views; writes ``evaluation.json`` beside it.

    Args:
        target: A run folder, or a `.r5dgs` file.
        data: The data set; by default the one a run was trained on.
        modes: Playback modes.
        json_path: Where the result goes instead.
        progress_kind: How progress is shown (`progress.make`).

    Returns:
        The evaluation, in the shape of ``evaluation.json``.
    """
    from rich.console import Console

    from .progress import make
    from .report import evaluate, table
    from .train import checkpoint

    for mode in modes:
        check_mode(mode)
    _check_json(json_path)
    scene, dataset = open_target(target, data)
    if dataset is None:
        raise errors.DatasetError(f"{target}: name the data set to compare with: r5dgs evaluate {target} --data DIR")
    default = target / checkpoint.EVALUATION_FILE if target.is_dir() else target.with_suffix(".evaluation.json")
    for mode in modes:
        check_mode(mode, scene, target)
    with make(progress_kind) as progress:
        result = evaluate.evaluate(
            scene,
            dataset,
            modes=modes,
            train=scene.provenance.get("train"),
            progress=lambda done, total: progress({"event": "evaluate", "done": done, "total": total}),
        )
    path = json_path or default
    if progress_kind != "json":
        Console().print(table.make(result))
    evaluate.write(result, path)
    if progress_kind != "json":
        print(f"written: {path}")
    return result


def run_stability(json_path: Path | None = None, *, progress_kind: str = "none") -> bool:
    """Run the stiff, extreme and degenerate cases on this installation and print what came of them.

    Args:
        json_path: Where the rows go as JSON, or None.
        progress_kind: How progress is shown (`progress.make`); "json" prints no table.

    Returns:
        Whether all cases passed.
    """
    from rich.console import Console

    from .progress import make
    from .report import stability

    _check_json(json_path)
    with make(progress_kind) as progress:
        total = len(stability.CASES)
        rows = stability.run(
            progress=lambda done: progress({"event": "stability", "done": done, "total": total, "unit": "cases"})
        )
    if progress_kind != "json":
        Console().print(stability.make(rows))
        print(stability.summary(rows))
    if json_path is not None:
        stability.write(rows, json_path)
        if progress_kind != "json":
            print(f"written: {json_path}")
    return all(row.passed for row in rows)


def open_target(target: Path, data: Path | None) -> tuple[Scene, Dataset | None]:
    """The scene of a run folder or a scene file, and the data set: of a file only where it is named."""
    from .data import dataset as datasets
    from .scene import scene_file
    from .train import bake, checkpoint

    if target.is_dir():
        run = checkpoint.open_run(target)
        dataset = datasets.read(run.data(data), run.config.data.masks)
        scene, trained_on = bake.bake(run, dataset), run.digest
    else:
        scene = scene_file.read(target)
        dataset = None if data is None else datasets.read(data)
        trained_on = scene.provenance.get("dataset_digest")
    if dataset is not None and trained_on is not None and trained_on != dataset.digest:
        log.warning("%s: %s was trained on other data than this; it is used all the same", dataset.root, target)
    return scene, dataset


def check_mode(mode: str, scene: Scene | None = None, place: object = "") -> None:
    """Refuse a playback mode that there is not, or that a scene, which is said by its place, has no data for."""
    from .scene import playback

    try:
        playback.split(mode)
    except ValueError:
        raise errors.ConfigError(f"--mode {mode}: expected one of {', '.join(playback.every())}") from None
    if scene is not None and not playback.available(scene, mode):
        raise errors.ConfigError(f"--mode {mode}: {place} has data for {', '.join(playback.modes(scene))} only")


def _check_json(path: Path | None) -> None:
    if path is not None and (path.is_dir() or not path.parent.is_dir()):
        expected = "a file" if path.is_dir() else f"the folder {path.parent} to exist; make it first"
        raise errors.ConfigError(f"--json {path}: expected {expected}")


def run_report(
    target: Path,
    data: Path | None,
    out: Path,
    *,
    tasks: Sequence[str] | None = None,
    splits: Sequence[str] | None = None,
    rounds: int | None = None,
    clock: str = "wall",
    progress_kind: str = "none",
) -> dict[str, Any]:
    """Measure error against run time of a run or scene file (see `report.error_time`) and write it to a folder.

    Args:
        target: A run folder, or a `.r5dgs` file.
        data: The data set; by default the one a run was trained on, none for a file.
        out: Folder of ``report.json``, ``.csv``, ``.md`` and ``.png``.
        tasks: What to measure, all where None.
        splits: Splits whose images are compared, "test" where None.
        rounds: Rounds of timing, the report's own number where None.
        clock: "wall", or "cpu" for processor time.
        progress_kind: How progress is shown (`progress.make`).

    Returns:
        The report, in the shape of ``report.json``.
    """
    from .data import dataset as datasets
    from .progress import make
    from .report import error_time, report_rows, report_table

    for kind, given, known in (("tasks", tasks, report_rows.TASKS), ("splits", splits, datasets.SPLITS)):
        for name in given or ():
            if name not in known:
                raise errors.ConfigError(f"--{kind} {name}: expected some of {', '.join(known)}")
    if rounds is not None and rounds < 1:
        raise errors.ConfigError(f"--repeats {rounds}: expected 1 or more")
    if out.exists() and not out.is_dir():
        raise errors.ConfigError(f"--out {out}: expected a folder, or nothing yet; found a file")
    scene, dataset = open_target(target, data)
    if dataset is None and tasks and set(tasks) <= {"images", "poses"}:
        given = " ".join(tasks)
        raise errors.ConfigError(f"--tasks {given}: needs the data set: r5dgs report {target} DATA --out {out}")
    with make(progress_kind) as progress:
        result = error_time.measure(
            scene,
            dataset,
            tasks=tasks or report_rows.TASKS,
            splits=splits or ("test",),
            rounds=rounds or error_time.ROUNDS,
            clock=clock,
            progress=progress,
        )
    paths = error_time.write(result, out)
    if progress_kind != "json":
        report_table.show(result)
        print("\n".join(f"written: {path}" for path in paths))
    return result


def run_info(path: Path, *, as_json: bool) -> None:
    """Say what is in a scene file."""
    from .scene import scene_file

    found = scene_file.info(scene_file.read(path))
    if as_json:
        print(json.dumps(found, indent=2))
        return
    for key, value in found.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            print(f"{key}:")
            for row in value:
                print(
                    "  "
                    + "  ".join(f"{name}={_short(item)}" for name, item in row.items() if item not in ("", [], None))
                )
        else:
            print(f"{key}: {_short(value)}")


def run_warm_up(*, progress_kind: str) -> dict[str, Any]:
    """Compile the kernels of rasterizer and training, so that no first picture has to wait for that.

    Args:
        progress_kind: How progress is shown (`progress.make`).

    Returns:
        ``seconds`` it took, kernels ``compiled`` (none where an earlier call did that) and the ``folder`` that keeps
        them, None where there is no place.
    """
    from .progress import make

    try:
        from .raster import compile as compilation
        from .train import warming
    except ImportError as error:
        raise errors.BackendError(f"warm-up: {sys.executable} lacks '{error.name}'; install r5dgs again") from error

    with make(progress_kind) as progress, compilation.telling(lambda text: progress({"event": "notice", "text": text})):
        seconds = warming.warm_up(lambda stage: progress({"event": "prepare", "text": stage}))
        folder = compilation.cache_folder()
        compiled = compilation.compiled()
        result = {"seconds": round(seconds, 2), "compiled": compiled, "folder": None if folder is None else str(folder)}
        if progress_kind == "json":
            progress({"event": "ready", **result})
    if progress_kind != "json":
        done = f"compiled {compiled} kernels in {seconds:.1f} s" if compiled else f"ready: loaded in {seconds:.1f} s"
        print(f"{done}; kept in {folder}" if folder else f"{done}; not kept, as no folder can be written")
    return result


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)

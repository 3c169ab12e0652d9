"""The ``r5dgs`` command: demo, train, bake, import, evaluate, report, bench, info, warm-up.

Each sub-command is a function ``run_<name>`` that does the work and can be called without the command line.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__, errors
from .bench import variants

if TYPE_CHECKING:
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

    _check_scene_name(out)
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

    _check_scene_name(out)
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


def _check_scene_name(out: Path) -> None:
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

    from .data import dataset as datasets
    from .progress import make
    from .report import evaluate, table
    from .scene import playback, scene_file
    from .train import bake, checkpoint

    for mode in modes:
        try:
            playback.split(mode)
        except ValueError:
            raise errors.ConfigError(f"--mode {mode}: expected one of {', '.join(playback.every())}") from None
    _check_json(json_path)
    trained_on = None
    if target.is_dir():
        run = checkpoint.open_run(target)
        dataset = datasets.read(run.data(data))
        scene = bake.bake(run, dataset)
        trained_on = run.digest
        default = target / checkpoint.EVALUATION_FILE
    else:
        scene = scene_file.read(target)
        if data is None:
            raise errors.DatasetError(
                f"{target}: name the data set to compare with: r5dgs evaluate {target} --data DIR"
            )
        dataset = datasets.read(data)
        trained_on = scene.provenance.get("dataset_digest")
        default = target.with_suffix(".evaluation.json")
    if trained_on is not None and trained_on != dataset.digest:
        log.warning("%s: %s was trained on other data; measured all the same", dataset.root, target)
    for mode in modes:
        if not playback.available(scene, mode):
            raise errors.ConfigError(f"--mode {mode}: {target} has data for {', '.join(playback.modes(scene))} only")
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
    from .scene import scene_file
    from .train import bake, checkpoint

    for kind, given, known in (("tasks", tasks, report_rows.TASKS), ("splits", splits, datasets.SPLITS)):
        for name in given or ():
            if name not in known:
                raise errors.ConfigError(f"--{kind} {name}: expected some of {', '.join(known)}")
    if rounds is not None and rounds < 1:
        raise errors.ConfigError(f"--repeats {rounds}: expected 1 or more")
    if out.exists() and not out.is_dir():
        raise errors.ConfigError(f"--out {out}: expected a folder, or nothing yet; found a file")
    if target.is_dir():
        run = checkpoint.open_run(target)
        dataset = datasets.read(run.data(data))
        scene, trained_on = bake.bake(run, dataset), run.digest
    else:
        scene = scene_file.read(target)
        dataset = None if data is None else datasets.read(data)
        trained_on = scene.provenance.get("dataset_digest")
    if dataset is not None and trained_on is not None and trained_on != dataset.digest:
        log.warning("%s: %s was trained on other data; measured all the same", dataset.root, target)
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


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(prog="r5dgs", description="Semantic 4D Gaussians: train, bake, evaluate.")
    top.add_argument("--version", action="version", version=f"r5dgs {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add_settings(p: argparse.ArgumentParser) -> None:
        named = "named settings: fast (a first look), cpu or paper (the deformation field); --config and --set win"
        p.add_argument("--preset", metavar="NAME", help=named)
        p.add_argument("--config", type=Path, metavar="FILE", help="TOML configuration")
        p.add_argument(
            "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a key; may be repeated"
        )
        p.add_argument("--max-gaussians", metavar="N", help="cap from the first step on; densify.max_gaussians")
        add_progress(p)

    def add_training(p: argparse.ArgumentParser) -> None:
        add_settings(p)
        again = p.add_mutually_exclusive_group()
        again.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
        again.add_argument("--overwrite", action="store_true", help="begin again where there is a run")

    def add_progress(p: argparse.ArgumentParser) -> None:
        p.add_argument("--progress", choices=("auto", "json", "none"), default="auto", help="how progress is shown")

    demo = commands.add_parser("demo", help="train, bake and measure the bundled data set")
    demo.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="run folder (default: demo)")
    add_training(demo)

    train = commands.add_parser("train", help="train a data set into a run folder")
    train.add_argument("data", type=Path, help="data set folder: transforms_train.json, or images and sparse/")
    train.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder")
    add_training(train)

    bake = commands.add_parser("bake", help="turn a run into a scene file")
    bake.add_argument("run", type=Path, help="run folder")
    bake.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    bake.add_argument("--data", type=Path, metavar="DIR", help="data set, where it has moved")
    bake.add_argument(
        "--set", action="append", default=[], metavar="needs.NAME=on|off", help="override a need; may be repeated"
    )

    foreign = commands.add_parser("import", help="turn a run folder of 3DGS and its kin into a scene file")
    foreign.add_argument(
        "run", type=Path, help="run folder of 3DGS, Gaussian Grouping, Deformable-3DGS, TRACE, FreeGave"
    )
    foreign.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    foreign.add_argument("--iteration", type=int, metavar="N", help="iteration to read (default: the last)")
    foreign.add_argument("--data", type=Path, metavar="DIR", help="data set of the run: its cameras, times and axes")
    foreign.add_argument("--knots", type=int, metavar="N", help="times to sample motion at (default: the data set's)")
    foreign.add_argument("--t-max", type=float, metavar="T", help="last observed time (default: the run's)")
    foreign.add_argument("--world", metavar="NAME", help="axes of the world: blender, colmap or opengl")
    foreign.add_argument("--still", type=float, metavar="SHARE", help="motion below this share of the extent is none")
    add_progress(foreign)

    evaluate = commands.add_parser("evaluate", help="measure a run or scene on held-out views")
    evaluate.add_argument("target", type=Path, help="run folder or .r5dgs file")
    evaluate.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    kinds = "playback mode, BASE or BASE/VARIANT (default: rigid); may be repeated"
    evaluate.add_argument("--mode", action="append", metavar="MODE", help=kinds)
    evaluate.add_argument("--json", type=Path, metavar="FILE", help="where evaluation.json goes instead")
    add_progress(evaluate)

    report = commands.add_parser("report", help="error against run time of a run or scene; or --stability")
    report.add_argument("target", type=Path, nargs="?", metavar="RUN|SCENE", help="run folder or .r5dgs file")
    report.add_argument("data", type=Path, nargs="?", metavar="DATA", help="data set (default: the run's own)")
    report.add_argument("--out", type=Path, metavar="DIR", help="folder of report.json, .csv, .md and .png")
    report.add_argument("--tasks", nargs="+", metavar="TASK", help="of dynamics, poses, images, raster (default: all)")
    report.add_argument("--splits", nargs="+", metavar="SPLIT", help="of val, test: images to compare (default: test)")
    report.add_argument("--repeats", type=int, metavar="N", help="rounds of timing (default: 7)")
    report.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="what ms is: wall or processor time")
    report.add_argument("--stability", action="store_true", help="stiff and extreme cases instead; needs no scene")
    report.add_argument("--json", type=Path, metavar="FILE", help="where --stability writes its rows")
    add_progress(report)

    some, usual = ", ".join(variants.VARIANTS), " ".join(variants.DEFAULT_VARIANTS)
    bench = commands.add_parser("bench", help="train variants on scenes and lay out the paper's tables")
    bench.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="data set folders")
    bench.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the runs and the tables")
    bench.add_argument("--variants", nargs="+", metavar="NAME", help=f"of {some} (default: {usual})")
    bench.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N", help="seeds of training (default: 0)")
    bench.add_argument("--modes", nargs="+", metavar="MODE", help="playback modes (default: one of each base)")
    bench.add_argument("--remeasure", action="store_true", help="bake and measure finished runs again")
    add_settings(bench)

    info = commands.add_parser("info", help="say what is in a scene file")
    info.add_argument("file", type=Path, help=".r5dgs file")
    info.add_argument("--json", action="store_true", help="as JSON")

    warm_up = commands.add_parser("warm-up", help="compile the kernels now, once, instead of at the first picture")
    add_progress(warm_up)
    return top


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 1 for an error that the user can act on or a case that fails,
    130 when stopped."""
    args = parser().parse_args(arguments)
    try:
        return _dispatch(args)
    except errors.Interrupted as stop:
        print(f"r5dgs: {stop}", file=sys.stderr)
        return 130
    except errors.R5dgsError as error:
        print(f"r5dgs: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("r5dgs: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read our output has gone; what is left of it goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _dispatch(args: argparse.Namespace) -> int:
    """Do what the command line says; returns the exit status."""
    cap = getattr(args, "max_gaussians", None)
    overrides = [*getattr(args, "set", []), *([] if cap is None else [f"densify.max_gaussians={cap}"])]
    if args.command in ("demo", "train"):
        options = {
            "config_path": args.config,
            "overrides": overrides,
            "preset": args.preset,
            "resume": args.resume,
            "overwrite": args.overwrite,
            "progress_kind": args.progress,
        }
        if args.command == "train":
            run_train(args.data, args.out, **options)
        else:
            from .demo import run_demo

            run_demo(args.out, **options)
    elif args.command == "bake":
        run_bake(args.run, args.out, args.data, overrides)
    elif args.command == "import":
        names = ("iteration", "data", "knots", "t_max", "world", "still")
        options = {name: getattr(args, name) for name in names}
        run_import(args.run, args.out, progress_kind=args.progress, **options)
    elif args.command == "evaluate":
        run_evaluate(
            args.target, args.data, modes=args.mode or ["rigid"], json_path=args.json, progress_kind=args.progress
        )
    elif args.command == "report":
        measured = (args.target, args.out, args.tasks, args.splits, args.repeats)
        if args.stability and any(given is not None for given in measured):
            raise errors.ConfigError("report --stability: needs no scene; takes --json FILE alone")
        if args.json is not None and not args.stability:
            raise errors.ConfigError("report --json: is for --stability; a report's JSON goes to --out DIR/report.json")
        if args.stability:
            return 0 if run_stability(args.json, progress_kind=args.progress) else 1
        if args.target is None or args.out is None:
            raise errors.ConfigError("report: expected RUN|SCENE and --out DIR, or --stability")
        options = {"tasks": args.tasks, "splits": args.splits, "rounds": args.repeats, "clock": args.clock}
        run_report(args.target, args.data, args.out, **options, progress_kind=args.progress)
    elif args.command == "bench":
        from .bench import benchmark, cases
        from .scene import playback

        plan = cases.Plan(
            scenes=tuple(args.scenes),
            out=args.out,
            variants=tuple(args.variants or variants.DEFAULT_VARIANTS),
            seeds=tuple(args.seeds),
            modes=tuple(args.modes or playback.MODES),
            preset=args.preset,
            config_path=args.config,
            overrides=tuple(overrides),
        )
        benchmark.run_bench(plan, remeasure=args.remeasure, progress_kind=args.progress)
    elif args.command == "warm-up":
        run_warm_up(progress_kind=args.progress)
    else:
        run_info(args.file, as_json=args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())

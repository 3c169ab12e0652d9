"""The ``r5dgs`` command: demo, train, masks, associate, bake, import, evaluate, report, bench, info, objects, lookup,
query, name, warm-up.

What each sub-command does is in `commands` and its neighbours.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from . import __version__, commands, errors
from .bench import variants


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
    shown = "masks of the training views (default: DATA/object_mask); 'none': without"
    train.add_argument("--masks", metavar="FOLDER", help=shown)
    add_training(train)

    masks = commands.add_parser("masks", help="make masks of the training images, or check those that stand")
    masks.add_argument("data", type=Path, help="data set folder")
    made = "precomputed (a folder; the default), blender (of the capture) or sam2"
    masks.add_argument("--backend", default="precomputed", metavar="NAME", help=made)
    masks.add_argument("--from", dest="source", type=Path, metavar="FOLDER", help="folder of masks, or of a capture")
    masks.add_argument("--model", type=Path, metavar="DIR", help="folder of SAM2")
    masks.add_argument("--out", type=Path, metavar="FOLDER", help="where masks go (default: DATA/object_mask)")
    key_frames = "images of each video in which sam2 looks for everything (default: 3)"
    masks.add_argument("--key-frames", type=int, metavar="N", help=key_frames)
    masks.add_argument("--points", type=int, metavar="N", help="points per side that sam2 asks at (default: 32)")
    masks.add_argument("--score", type=float, metavar="SHARE", help="least quality that sam2 foretells (default: 0.8)")
    stability = "least IoU of a mask at two thresholds (default: 0.95)"
    masks.add_argument("--stability", type=float, metavar="SHARE", help=stability)
    max_area = "larger masks are background, as a share of the image (default: 0.4)"
    masks.add_argument("--max-area", type=float, metavar="SHARE", help=max_area)
    masks.add_argument("--device", metavar="NAME", help="cpu (the default) or cuda, for sam2")
    masks.add_argument("--unknown", type=int, metavar="VALUE", help="255: value in the folder's masks for 'unknown'")
    masks.add_argument("--overwrite", action="store_true", help="begin anew where there are other masks")
    add_progress(masks)

    associate = commands.add_parser("associate", help="give masks that a tracker numbered wrongly one numbering")
    associate.add_argument(
        "target", type=Path, metavar="RUN|SCENE", help="what shows the segments: a run, best without masks"
    )
    associate.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    incoming = "masks to renumber (default: the run's, or DATA/object_mask where it was trained without)"
    associate.add_argument("--masks", type=Path, metavar="FOLDER", help=incoming)
    associate.add_argument("--out", type=Path, metavar="FOLDER", help="where masks go (default: RUN/object_mask)")
    add_progress(associate)

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

    def add_picture(p: argparse.ArgumentParser) -> None:
        p.add_argument("--camera", metavar="N", help="name or number of the picture's camera (default: the best)")
        p.add_argument("--time", type=float, metavar="T", help="scene time of the picture, past t_max too")
        p.add_argument("--mode", default="rigid", metavar="MODE", help="playback mode (default: rigid)")
        p.add_argument("--size", type=int, metavar="PIXELS", help="of the picture along its longer side")

    objects = commands.add_parser("objects", help="say which id is what, in a table and a picture")
    objects.add_argument("target", type=Path, metavar="SCENE", help="run folder or .r5dgs file")
    objects.add_argument("--data", type=Path, metavar="DIR", help="data set to count pixels in (default: the run's)")
    objects.add_argument("--legend", type=Path, metavar="FILE.png", help="picture of the scene with ids and names")
    objects.add_argument("--json", action="store_true", help="as JSON")
    add_picture(objects)

    words = commands.add_parser("lookup", help="teach a scene what words its objects mean")
    words.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file; the table is written into it")
    words.add_argument("--encoder", required=True, metavar="DIR|text", help="folder of the encoder; text: a small one")
    words.add_argument("--out", type=Path, metavar="FILE.r5dgs", help="scene file to write instead")
    words.add_argument("--captions", type=Path, metavar="FILE.json", help="by id or name: captions, names, aliases")
    words.add_argument("--words", type=Path, metavar="FILE.txt", help="more words to store, one a line")
    add_progress(words)

    query = commands.add_parser("query", help="say which objects a text names or means, or that none does")
    query.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    query.add_argument("text", help="one or several things: 'red mug', 'mugs and lemon'")
    query.add_argument("--encoder", metavar="DIR|text", help="that of the scene's table, for words it does not store")
    query.add_argument("--threshold", type=float, metavar="SCORE", help="least score of a match, 0 to 1 (default: 0.5)")
    query.add_argument("--json", action="store_true", help="as JSON")
    query.add_argument("--render", type=Path, metavar="FILE.png", help="picture of what was found, alone, with alpha")
    query.add_argument("--context", action="store_true", help="in that picture, show the rest too, dimmed")
    add_picture(query)

    name = commands.add_parser("name", help="name an object of a scene, and say what else it is called")
    name.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file, which is changed")
    name.add_argument("object", help="id or name of the object")
    name.add_argument("name", nargs="?", help="its new name")
    name.add_argument("--alias", action="append", default=[], metavar="WORD", help="a word that finds it; repeatable")
    name.add_argument("--caption", metavar="TEXT", help="a sentence about it")

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
    if args.command == "train" and args.masks is not None:
        overrides.append(f"data.masks={args.masks if args.masks == 'none' else str(Path(args.masks).resolve())}")
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
            commands.run_train(args.data, args.out, **options)
        else:
            from .demo import run_demo

            run_demo(args.out, **options)
    elif args.command == "masks":
        from . import commands_masks

        names = ("backend", "model", "source", "out", "key_frames", "points", "score", "stability", "max_area")
        options = {name: getattr(args, name) for name in (*names, "device", "unknown", "overwrite")}
        commands_masks.run_masks(args.data, **options, progress_kind=args.progress)
    elif args.command == "associate":
        from . import commands_association

        options = {"masks": args.masks, "out": args.out}
        commands_association.run_associate(args.target, args.data, **options, progress_kind=args.progress)
    elif args.command == "bake":
        commands.run_bake(args.run, args.out, args.data, overrides)
    elif args.command == "import":
        names = ("iteration", "data", "knots", "t_max", "world", "still")
        options = {name: getattr(args, name) for name in names}
        commands.run_import(args.run, args.out, progress_kind=args.progress, **options)
    elif args.command == "evaluate":
        commands.run_evaluate(
            args.target, args.data, modes=args.mode or ["rigid"], json_path=args.json, progress_kind=args.progress
        )
    elif args.command == "report":
        measured = (args.target, args.out, args.tasks, args.splits, args.repeats)
        if args.stability and any(given is not None for given in measured):
            raise errors.ConfigError("report --stability: needs no scene; takes --json FILE alone")
        if args.json is not None and not args.stability:
            raise errors.ConfigError("report --json: is for --stability; a report's JSON goes to --out DIR/report.json")
        if args.stability:
            return 0 if commands.run_stability(args.json, progress_kind=args.progress) else 1
        if args.target is None or args.out is None:
            raise errors.ConfigError("report: expected RUN|SCENE and --out DIR, or --stability")
        options = {"tasks": args.tasks, "splits": args.splits, "rounds": args.repeats, "clock": args.clock}
        commands.run_report(args.target, args.data, args.out, **options, progress_kind=args.progress)
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
    elif args.command == "objects":
        from . import commands_objects

        commands_objects.run_objects(args.target, args.data, legend=args.legend, as_json=args.json, **_picture(args))
    elif args.command in ("lookup", "query", "name"):
        from . import commands_words

        if args.command == "lookup":
            options = {"out": args.out, "captions": args.captions, "words": args.words}
            commands_words.run_lookup(args.file, args.encoder, **options, progress_kind=args.progress)
        elif args.command == "query":
            from . import commands_objects

            options = {"encoder": args.encoder, "threshold": args.threshold, "as_json": args.json}
            picture = {"render": args.render, "context": args.context, **_picture(args)}
            commands_objects.run_query(args.file, args.text, options, **picture)
        else:
            commands_words.run_name(args.file, args.object, args.name, aliases=args.alias, caption=args.caption)
    elif args.command == "warm-up":
        commands.run_warm_up(progress_kind=args.progress)
    else:
        commands.run_info(args.file, as_json=args.json)
    return 0


def _picture(args: argparse.Namespace) -> dict[str, Any]:
    """What a command was told of its picture."""
    return {"camera": args.camera, "t": args.time, "mode": args.mode, "size": args.size}


if __name__ == "__main__":
    sys.exit(main())

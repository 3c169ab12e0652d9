"""Arguments of every ``r5dgs`` command, with a description, an example and a page of the documentation."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .. import __version__
from ..bench import variants
from ..playback import modes
from . import export, options

TASKS = ("dynamics", "poses", "images", "raster")  # of `error_vs_time.report_rows`
SPLITS = ("train", "val", "test")  # of `data.dataset`
WORLDS = ("blender", "colmap", "opengl")  # of `scene.cameras`


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; its result holds the parser of the command as ``parser_of``."""
    top = argparse.ArgumentParser(
        prog="r5dgs",
        description="Train semantic 4D Gaussians from multi-view video, bake them into a scene for Blender, and "
        "evaluate it. Training runs on the CPU.",
        epilog=_epilog("r5dgs demo", "README.md and docs/reference/command_line.md"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"r5dgs {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in _COMMANDS:
        add(commands)
    return top


def _command(commands: Any, name: str, short: str, long: str, example: str, page: str) -> argparse.ArgumentParser:
    """Add a command with its short description for the list, long description, example and documentation page."""
    p = commands.add_parser(
        name,
        help=short,
        description=long,
        epilog=_epilog(f"r5dgs {name}{' ' * bool(example)}{example}", f"docs/{page}"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.set_defaults(parser_of=p)
    return p


def _epilog(example: str, page: str) -> str:
    return f"example:\n  {example}\n\nread more: {page}"


def _demo(commands: Any) -> None:
    p = _command(
        commands,
        "demo",
        "train, bake and evaluate the bundled data set",
        "Train the bundled data set, bake a scene file, evaluate it on held-out views and draw a contact sheet.\n"
        "Takes about two minutes on two cores.",
        "--out demo",
        "user/training.md",
    )
    p.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="run folder (default: demo)")
    options.add_training(p)


def _train(commands: Any) -> None:
    p = _command(
        commands,
        "train",
        "train on a data set and write a run folder",
        "Train 4D Gaussians from posed images and object masks. Use --resume to continue a stopped run.",
        "DATA --out RUN",
        "user/training.md",
    )
    p.add_argument("data", type=Path, help="data set folder: transforms_train.json, or images and sparse/")
    p.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder to write")
    shown = "masks of the training views (default: DATA/object_mask); 'none' trains without masks"
    p.add_argument("--masks", metavar="FOLDER", help=shown)
    options.add_training(p)


def _masks(commands: Any) -> None:
    p = _command(
        commands,
        "masks",
        "make or check the masks of the training images",
        "Make object masks with SAM2, convert masks of another program, or check the masks of a data set.",
        "DATA --backend sam2 --model SAM2_FOLDER",
        "user/masks.md",
    )
    p.add_argument("data", type=Path, help="data set folder")
    made = "source of the masks: precomputed (a folder; default), blender (a captured data set) or sam2"
    p.add_argument("--backend", default="precomputed", metavar="NAME", help=made)
    source = "folder of the masks (precomputed), or captured data set (blender)"
    p.add_argument("--from", dest="source", type=Path, metavar="FOLDER", help=source)
    model = "folder of the SAM2 weights (default: sam2 of 'r5dgs config --user')"
    p.add_argument("--model", type=Path, metavar="DIR", help=model)
    p.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: DATA/object_mask)")
    key_frames = "images per video in which sam2 searches for all objects (default: 3)"
    p.add_argument("--key-frames", type=int, metavar="N", help=key_frames)
    points = "points along each side of the prompt grid of sam2 (default: 32)"
    p.add_argument("--points", type=int, metavar="N", help=points)
    score = "minimum quality that sam2 predicts for a mask, 0 to 1 (default: 0.8)"
    p.add_argument("--score", type=float, metavar="SHARE", help=score)
    stability = "minimum IoU of a mask at two thresholds, 0 to 1 (default: 0.95)"
    p.add_argument("--stability", type=float, metavar="SHARE", help=stability)
    max_area = "maximum area of an object as a share of the image; larger masks are background (default: 0.4)"
    p.add_argument("--max-area", type=float, metavar="SHARE", help=max_area)
    p.add_argument("--device", metavar="NAME", help="device that runs sam2: cpu (default) or cuda")
    unknown = "mask value of pixels whose object is unknown, for example 255"
    p.add_argument("--unknown", type=int, metavar="VALUE", help=unknown)
    p.add_argument("--overwrite", action="store_true", help="replace existing masks")
    options.add_progress(p)


def _associate(commands: Any) -> None:
    p = _command(
        commands,
        "associate",
        "make mask ids consistent across images and videos",
        "Correct masks whose ids are switched, split or numbered per video, by the geometry and motion of a run.",
        "RUN --masks FOLDER",
        "user/associate.md",
    )
    target = "run folder (best trained without masks) or .r5dgs file"
    p.add_argument("target", type=Path, metavar="RUN|SCENE", help=target)
    p.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    incoming = "masks to correct (default: those of the run, or DATA/object_mask if it was trained without masks)"
    p.add_argument("--masks", type=Path, metavar="FOLDER", help=incoming)
    p.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: RUN/object_mask)")
    options.add_threads(p)
    options.add_progress(p)


def _bake(commands: Any) -> None:
    p = _command(
        commands,
        "bake",
        "convert a run to a scene file",
        "Convert a trained run to the .r5dgs file that Blender loads, and print a summary of the scene.",
        "RUN --out scene.r5dgs",
        "user/training.md",
    )
    p.add_argument("run", type=Path, help="run folder")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set folder, if it was moved")
    options.add_overrides(p, "needs.NAME=on|off", "override a detected need of the scene")
    p.add_argument("--needs", action="store_true", help="also print the table of the scene's needs")
    options.add_threads(p)
    options.add_progress(p)


def _import(commands: Any) -> None:
    p = _command(
        commands,
        "import",
        "convert a run of 3DGS or a related program to a scene file",
        "Read a run folder of 3DGS, Gaussian Grouping, Deformable-3DGS, TRACE or FreeGave and write a scene file.",
        "OUTPUT --data DATA --out scene.r5dgs",
        "user/import.md",
    )
    p.add_argument("run", type=Path, help="run folder of the other program")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--iteration", type=options.at_least(0), metavar="N", help="iteration to read (default: last)")
    data = "data set of the run, which provides cameras, times and axes"
    p.add_argument("--data", type=Path, metavar="DIR", help=data)
    knots = "number of times at which motion is sampled (default: those of the data set)"
    p.add_argument("--knots", type=options.at_least(2), metavar="N", help=knots)
    p.add_argument("--t-max", type=options.positive, metavar="T", help="last observed time (default: the run's)")
    p.add_argument("--world", choices=WORLDS, help="world axes (default: those of the data set)")
    still = "largest motion that counts as rest, as a share of the extent"
    p.add_argument("--still", type=options.not_negative, metavar="SHARE", help=still)
    options.add_progress(p)


def _evaluate(commands: Any) -> None:
    p = _command(
        commands,
        "evaluate",
        "measure a run or scene on held-out views",
        "Render the held-out views of a run or scene, compare them with the images, and write evaluation.json.",
        "RUN --mode rigid --mode standard",
        "reference/evaluation.md",
    )
    p.add_argument("target", type=Path, help="run folder or .r5dgs file")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    kinds = f"playback mode, one of {', '.join(modes.every())} (default: rigid); may be repeated"
    p.add_argument("--mode", action="append", metavar="MODE", help=kinds)
    p.add_argument("--json", type=Path, metavar="FILE", help="file to write instead of evaluation.json")
    options.add_threads(p)
    options.add_progress(p)


def _report(commands: Any) -> None:
    p = _command(
        commands,
        "report",
        "measure error against run time, or test numerical stability",
        "Measure error against run time of motion models, playback modes and rasterizer settings. With --stability,\n"
        "run the stiff and extreme cases of the motion code instead; the exit status is 1 if a case fails.",
        "RUN --out report",
        "user/report.md",
    )
    p.add_argument("target", type=Path, nargs="?", metavar="RUN|SCENE", help="run folder or .r5dgs file")
    p.add_argument("data", type=Path, nargs="?", metavar="DATA", help="data set (default: the run's own)")
    p.add_argument("--out", type=Path, metavar="DIR", help="output folder for report.json, .csv, .md and .png")
    tasks = f"tasks to measure, of {', '.join(TASKS)} (default: all)"
    p.add_argument("--tasks", nargs="+", choices=TASKS, metavar="TASK", help=tasks)
    splits = "splits whose images are compared, of val, test (default: test)"
    p.add_argument("--splits", nargs="+", choices=SPLITS, metavar="SPLIT", help=splits)
    p.add_argument("--repeats", type=options.at_least(1), metavar="N", help="timing rounds (default: 7)")
    clock = "clock for timings: wall (default), or cpu for processor time"
    p.add_argument("--clock", choices=("wall", "cpu"), default="wall", help=clock)
    stability = "run the stiff and extreme cases instead; needs no scene"
    p.add_argument("--stability", action="store_true", help=stability)
    p.add_argument("--json", type=Path, metavar="FILE", help="write the results of --stability to this file")
    options.add_threads(p)
    options.add_progress(p)


def _bench(commands: Any) -> None:
    some, usual = ", ".join(variants.VARIANTS), " ".join(variants.DEFAULT_VARIANTS)
    p = _command(
        commands,
        "bench",
        "train variants on scenes and write the paper's tables",
        "Train variants of the method on data sets, measure each in every playback mode, and write the paper's tables.",
        "DATA1 DATA2 --out tables --seeds 0 1 2",
        "user/bench.md",
    )
    p.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="data set folders")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder for runs and tables")
    p.add_argument("--variants", nargs="+", metavar="NAME", help=f"variants to train, of {some} (default: {usual})")
    seeds = "random seeds, one run for each (default: 0)"
    p.add_argument("--seeds", type=options.at_least(0), nargs="+", default=[0], metavar="N", help=seeds)
    played = f"playback modes to measure, of {', '.join(modes.every())} (default: one of each base)"
    p.add_argument("--modes", nargs="+", metavar="MODE", help=played)
    p.add_argument("--remeasure", action="store_true", help="bake and measure finished runs again")
    options.add_settings(p)


def _export(commands: Any) -> None:
    p = _command(
        commands,
        "export",
        "write a scene in a format of other programs",
        "Write the Gaussians of a scene at a time or for a range of frames as PLY, or its cameras as transforms.json.",
        "scene.r5dgs --to ply --out frame.ply --frames 1:60",
        "user/export.md",
    )
    export.add_arguments(p)


def _info(commands: Any) -> None:
    p = _command(
        commands,
        "info",
        "summarise a scene file",
        "Print duration, frames per second, extent, moving objects and quality of a scene file.",
        "scene.r5dgs",
        "reference/command_line.md",
    )
    p.add_argument("file", type=Path, help=".r5dgs file")
    p.add_argument("--needs", action="store_true", help="also print the table of the scene's needs")
    p.add_argument("--json", action="store_true", help="print all data as JSON")


def _check(commands: Any) -> None:
    p = _command(
        commands,
        "check",
        "list all faults of a data set, scene file or run",
        "List all faults of a data set, run folder, .r5dgs, .ply or .toml file, each with its remedy, errors first.\n"
        "The exit status is 1 if there are errors.",
        "DATA",
        "reference/check.md",
    )
    p.add_argument("target", type=Path, metavar="DATA|RUN|FILE", help="data set, run folder or file to check")
    p.add_argument("--json", action="store_true", help="print JSON instead of text")


def _objects(commands: Any) -> None:
    p = _command(
        commands,
        "objects",
        "list the objects of a run or scene, in a table and a picture",
        "List ids, names and sizes of the objects of a run or scene, and draw a picture labelled with them.",
        "scene.r5dgs --legend legend.png",
        "user/objects.md",
    )
    p.add_argument("target", type=Path, metavar="RUN|SCENE", help="run folder or .r5dgs file")
    data = "data set in whose views pixels are counted (default: that of the run)"
    p.add_argument("--data", type=Path, metavar="DIR", help=data)
    legend = "write a picture of the scene labelled with ids and names"
    p.add_argument("--legend", type=Path, metavar="FILE.png", help=legend)
    p.add_argument("--json", action="store_true", help="print JSON instead of the table")
    options.add_picture(p)


def _lookup(commands: Any) -> None:
    p = _command(
        commands,
        "lookup",
        "store word embeddings in a scene, for search by text",
        "Embed the objects and common nouns with an encoder, and store the embeddings in the scene file.",
        "scene.r5dgs --encoder CLIP_FOLDER",
        "user/words.md",
    )
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file; changed in place without --out")
    encoder = "folder of the encoder, or 'text' for a small one (default: encoder of 'r5dgs config --user')"
    p.add_argument("--encoder", metavar="DIR|text", help=encoder)
    p.add_argument("--out", type=Path, metavar="FILE.r5dgs", help="scene file to write instead of SCENE")
    captions = "JSON file of captions, names and aliases by object id or name"
    p.add_argument("--captions", type=Path, metavar="FILE.json", help=captions)
    words = "text file of additional words to store, one per line"
    p.add_argument("--words", type=Path, metavar="FILE.txt", help=words)
    options.add_threads(p)
    options.add_progress(p)


def _query(commands: Any) -> None:
    p = _command(
        commands,
        "query",
        "find the objects that a text describes",
        "Find the objects of a scene that a text describes. The exit status is 1 if nothing is found.",
        'scene.r5dgs "red mug"',
        "user/words.md",
    )
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    p.add_argument("text", help="one or more things to find: 'red mug', 'mugs and lemon'")
    encoder = (
        "encoder that made the lookup table, for words not stored in it (default: encoder of 'r5dgs config --user')"
    )
    p.add_argument("--encoder", metavar="DIR|text", help=encoder)
    p.add_argument("--threshold", type=float, metavar="SCORE", help="minimum score of a match, 0 to 1 (default: 0.5)")
    p.add_argument("--json", action="store_true", help="print JSON instead of the table")
    render = "write a picture of the objects found, on a transparent background"
    p.add_argument("--render", type=Path, metavar="FILE.png", help=render)
    context = "show the rest of the scene dimmed in the picture of --render"
    p.add_argument("--context", action="store_true", help=context)
    options.add_picture(p)


def _name(commands: Any) -> None:
    p = _command(
        commands,
        "name",
        "change the name of an object of a scene",
        "Change the name, aliases or caption of an object in a scene file.",
        'scene.r5dgs 3 "glazed donut" --alias pastry',
        "user/words.md",
    )
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file; changed in place")
    p.add_argument("object", help="id or name of the object")
    p.add_argument("name", nargs="?", help="new name")
    alias = "additional word for the object; may be repeated"
    p.add_argument("--alias", action="append", default=[], metavar="WORD", help=alias)
    p.add_argument("--caption", metavar="TEXT", help="sentence that describes the object")


def _config(commands: Any) -> None:
    p = _command(
        commands,
        "config",
        "print all training keys, or the user's settings",
        "Print every training key with its meaning, unit, default and value, for a run, a TOML file or the defaults.\n"
        "With --user, print the user's settings (paths of weights), or change one of them.",
        "RUN\n  r5dgs config --user set encoder ~/models/clip",
        "reference/command_line.md",
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument("target", type=Path, nargs="?", metavar="RUN|FILE.toml", help="run folder or TOML file")
    user = "print the user's settings; 'set KEY VALUE' changes one, 'set KEY \"\"' removes it"
    where.add_argument("--user", nargs="*", metavar="set KEY VALUE", help=user)
    p.add_argument("--json", action="store_true", help="print JSON instead of text")


def _warm_up(commands: Any) -> None:
    p = _command(
        commands,
        "warm-up",
        "compile the kernels now instead of on first use",
        "Compile the rasterizing and training kernels now, so that the first picture or training run does not wait.",
        "",
        "reference/rasterizer.md",
    )
    options.add_progress(p)


_COMMANDS = (
    *(_demo, _train, _masks, _associate, _bake, _import, _evaluate, _report, _bench),
    *(_export, _info, _check, _objects, _lookup, _query, _name, _config, _warm_up),
)

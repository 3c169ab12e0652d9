"""The arguments of every sub-command of ``r5dgs``, with its description, one example and the page to read."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .. import __version__
from ..bench import variants
from ..playback import modes
from . import options

TASKS = ("dynamics", "poses", "images", "raster")  # of `error_vs_time.report_rows`
SPLITS = ("train", "val", "test")  # of `data.dataset`
WORLDS = ("blender", "colmap", "opengl")  # of `scene.cameras`


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; ``parser_of`` of the result is the parser of its sub-command."""
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
    """Add a sub-command: a phrase for the list of commands, a description, an example and a page of the docs."""
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
        "train, bake and measure the bundled data set",
        "Train the bundled data set, bake a scene file, measure it on held-out views and draw a contact sheet.\n"
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
        "train a data set into a run folder",
        "Train 4D Gaussians from posed images and object masks. A stopped run goes on with --resume.",
        "DATA --out RUN",
        "user/training.md",
    )
    p.add_argument("data", type=Path, help="data set folder: transforms_train.json, or images and sparse/")
    p.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder")
    shown = "masks of the training views (default: DATA/object_mask); 'none' trains without masks"
    p.add_argument("--masks", metavar="FOLDER", help=shown)
    options.add_training(p)


def _masks(commands: Any) -> None:
    p = _command(
        commands,
        "masks",
        "make or check the masks of the training images",
        "Make object masks with SAM2, take over masks of another program, or check the masks of a data set.",
        "DATA --backend sam2 --model SAM2_FOLDER",
        "user/masks.md",
    )
    p.add_argument("data", type=Path, help="data set folder")
    made = "precomputed (a folder; the default), blender (of a capture) or sam2"
    p.add_argument("--backend", default="precomputed", metavar="NAME", help=made)
    p.add_argument("--from", dest="source", type=Path, metavar="FOLDER", help="folder of masks, or of a capture")
    p.add_argument("--model", type=Path, metavar="DIR", help="folder of SAM2 (default: sam2 of 'config --user')")
    p.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: DATA/object_mask)")
    key_frames = "images of each video in which sam2 looks for all objects (default: 3)"
    p.add_argument("--key-frames", type=int, metavar="N", help=key_frames)
    p.add_argument("--points", type=int, metavar="N", help="points per side that prompt sam2 (default: 32)")
    p.add_argument("--score", type=float, metavar="SHARE", help="least predicted quality of a mask (default: 0.8)")
    stability = "least IoU of a mask at two thresholds (default: 0.95)"
    p.add_argument("--stability", type=float, metavar="SHARE", help=stability)
    max_area = "larger masks are background, as a share of the image (default: 0.4)"
    p.add_argument("--max-area", type=float, metavar="SHARE", help=max_area)
    p.add_argument("--device", metavar="NAME", help="device of sam2: cpu (the default) or cuda")
    p.add_argument("--unknown", type=int, metavar="VALUE", help="mask value that means 'unknown', for example 255")
    p.add_argument("--overwrite", action="store_true", help="replace masks that are there")
    options.add_progress(p)


def _associate(commands: Any) -> None:
    p = _command(
        commands,
        "associate",
        "give masks with wrong ids one numbering",
        "Renumber masks whose ids are switched, broken or numbered per video, by the geometry and motion of a run.",
        "RUN --masks FOLDER",
        "user/associate.md",
    )
    p.add_argument("target", type=Path, metavar="RUN|SCENE", help="run folder, best trained without masks, or scene")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    incoming = "masks to renumber (default: the run's, or DATA/object_mask if it was trained without)"
    p.add_argument("--masks", type=Path, metavar="FOLDER", help=incoming)
    p.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: RUN/object_mask)")
    options.add_threads(p)
    options.add_progress(p)


def _bake(commands: Any) -> None:
    p = _command(
        commands,
        "bake",
        "turn a run into a scene file",
        "Turn a trained run into the .r5dgs file that Blender loads, and summarise the scene.",
        "RUN --out scene.r5dgs",
        "user/training.md",
    )
    p.add_argument("run", type=Path, help="run folder")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set, if it was moved")
    options.add_overrides(p, "needs.NAME=on|off", "override a need")
    p.add_argument("--needs", action="store_true", help="print the table of what the scene needs, too")
    options.add_threads(p)
    options.add_progress(p)


def _import(commands: Any) -> None:
    p = _command(
        commands,
        "import",
        "turn a run of 3DGS and related programs into a scene file",
        "Read a run folder of 3DGS, Gaussian Grouping, Deformable-3DGS, TRACE or FreeGave and write a scene file.",
        "OUTPUT --data DATA --out scene.r5dgs",
        "user/import.md",
    )
    p.add_argument("run", type=Path, help="run folder of the other program")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.r5dgs", help="scene file to write")
    p.add_argument("--iteration", type=options.at_least(0), metavar="N", help="iteration to read (default: last)")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set of the run: its cameras, times and axes")
    knots = "times at which motion is sampled (default: the data set's)"
    p.add_argument("--knots", type=options.at_least(2), metavar="N", help=knots)
    p.add_argument("--t-max", type=options.positive, metavar="T", help="last observed time (default: the run's)")
    p.add_argument("--world", choices=WORLDS, help="axes of the world (default: the data set's)")
    still = "motion below this share of the extent counts as rest"
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
    kinds = f"playback mode (default: rigid); may be repeated; of {', '.join(modes.every())}"
    p.add_argument("--mode", action="append", metavar="MODE", help=kinds)
    p.add_argument("--json", type=Path, metavar="FILE", help="write evaluation.json here instead")
    options.add_threads(p)
    options.add_progress(p)


def _report(commands: Any) -> None:
    p = _command(
        commands,
        "report",
        "error against run time of a run or scene; or --stability",
        "Measure error against run time of motion models, playback modes and rasterizer settings. With --stability\n"
        "run the stiff and extreme cases of the motion code instead; the exit status is 1 if a case fails.",
        "RUN --out report",
        "user/report.md",
    )
    p.add_argument("target", type=Path, nargs="?", metavar="RUN|SCENE", help="run folder or .r5dgs file")
    p.add_argument("data", type=Path, nargs="?", metavar="DATA", help="data set (default: the run's own)")
    p.add_argument("--out", type=Path, metavar="DIR", help="folder of report.json, .csv, .md and .png")
    p.add_argument("--tasks", nargs="+", choices=TASKS, metavar="TASK", help=f"of {', '.join(TASKS)} (default: all)")
    splits = "splits whose images are compared, of val, test (default: test)"
    p.add_argument("--splits", nargs="+", choices=SPLITS, metavar="SPLIT", help=splits)
    p.add_argument("--repeats", type=options.at_least(1), metavar="N", help="rounds of timing (default: 7)")
    p.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="measure wall or processor time")
    p.add_argument("--stability", action="store_true", help="stiff and extreme cases instead; needs no scene")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the rows of --stability here")
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
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the runs and the tables")
    p.add_argument("--variants", nargs="+", metavar="NAME", help=f"of {some} (default: {usual})")
    p.add_argument("--seeds", type=options.at_least(0), nargs="+", default=[0], metavar="N", help="seeds (default: 0)")
    played = f"playback modes, of {', '.join(modes.every())} (default: one of each base)"
    p.add_argument("--modes", nargs="+", metavar="MODE", help=played)
    p.add_argument("--remeasure", action="store_true", help="bake and measure finished runs again")
    options.add_settings(p)


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
    p.add_argument("--needs", action="store_true", help="print the table of what the scene needs, too")
    p.add_argument("--json", action="store_true", help="print everything as JSON")


def _check(commands: Any) -> None:
    p = _command(
        commands,
        "check",
        "list all faults of a data set, scene file or run",
        "List all faults of a data set, run folder, .r5dgs, .ply or .toml file, each with its remedy, errors first.\n"
        "Ends with status 1 if there are errors.",
        "DATA",
        "reference/check.md",
    )
    p.add_argument("target", type=Path, metavar="DATA|RUN|FILE", help="what to check")
    p.add_argument("--json", action="store_true", help="print JSON")


def _objects(commands: Any) -> None:
    p = _command(
        commands,
        "objects",
        "list the objects of a run or scene, in a table and a picture",
        "List ids, names and sizes of the objects of a run or scene, and draw a picture that names them.",
        "scene.r5dgs --legend legend.png",
        "user/objects.md",
    )
    p.add_argument("target", type=Path, metavar="RUN|SCENE", help="run folder or .r5dgs file")
    p.add_argument("--data", type=Path, metavar="DIR", help="data set to count pixels in (default: the run's)")
    p.add_argument("--legend", type=Path, metavar="FILE.png", help="picture of the scene with ids and names")
    p.add_argument("--json", action="store_true", help="print JSON")
    options.add_picture(p)


def _lookup(commands: Any) -> None:
    p = _command(
        commands,
        "lookup",
        "store in a scene what words its objects mean",
        "Compute embeddings of the objects and of common nouns with an encoder, and store them in the scene file.",
        "scene.r5dgs --encoder CLIP_FOLDER",
        "user/words.md",
    )
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file, which is changed")
    encoder = "folder of the encoder, or 'text' for a small one (default: encoder of 'config --user')"
    p.add_argument("--encoder", metavar="DIR|text", help=encoder)
    p.add_argument("--out", type=Path, metavar="FILE.r5dgs", help="write this scene file instead")
    p.add_argument("--captions", type=Path, metavar="FILE.json", help="captions, names, aliases by id or name")
    p.add_argument("--words", type=Path, metavar="FILE.txt", help="more words to store, one per line")
    options.add_threads(p)
    options.add_progress(p)


def _query(commands: Any) -> None:
    p = _command(
        commands,
        "query",
        "find the objects that a text names or means",
        "Find the objects of a scene that a text names or means. The exit status is 1 if nothing is found.",
        'scene.r5dgs "red mug"',
        "user/words.md",
    )
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    p.add_argument("text", help="one or several things: 'red mug', 'mugs and lemon'")
    encoder = "encoder of the scene's table, for words that it does not store (default: encoder of 'config --user')"
    p.add_argument("--encoder", metavar="DIR|text", help=encoder)
    p.add_argument("--threshold", type=float, metavar="SCORE", help="least score of a match, 0 to 1 (default: 0.5)")
    p.add_argument("--json", action="store_true", help="print JSON")
    p.add_argument("--render", type=Path, metavar="FILE.png", help="picture of the objects found, with alpha")
    p.add_argument("--context", action="store_true", help="show the rest of the scene in it, dimmed")
    options.add_picture(p)


def _name(commands: Any) -> None:
    p = _command(
        commands,
        "name",
        "name an object of a scene",
        "Change name, aliases and caption of an object in a scene file.",
        'scene.r5dgs 3 "glazed donut" --alias pastry',
        "user/words.md",
    )
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file, which is changed")
    p.add_argument("object", help="id or name of the object")
    p.add_argument("name", nargs="?", help="new name")
    p.add_argument("--alias", action="append", default=[], metavar="WORD", help="another word for it; may be repeated")
    p.add_argument("--caption", metavar="TEXT", help="a sentence about it")


def _config(commands: Any) -> None:
    p = _command(
        commands,
        "config",
        "print all training keys, or the user's settings",
        "Print every training key with meaning, unit, default and the value in force: of a run, of a TOML file, or\n"
        "the defaults. With --user print the user's settings (paths of weights), or change one of them.",
        "RUN\n  r5dgs config --user set encoder ~/models/clip",
        "reference/command_line.md",
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument("target", type=Path, nargs="?", metavar="RUN|FILE.toml", help="run folder or TOML file")
    user = "show the user's settings; 'set KEY VALUE' changes one, 'set KEY \"\"' removes it"
    where.add_argument("--user", nargs="*", metavar="set KEY VALUE", help=user)
    p.add_argument("--json", action="store_true", help="print JSON")


def _warm_up(commands: Any) -> None:
    p = _command(
        commands,
        "warm-up",
        "compile the kernels now instead of on first use",
        "Compile the kernels of rasterizer and training once, so that the first picture or training does not wait.",
        "",
        "reference/rasterizer.md",
    )
    options.add_progress(p)


_COMMANDS = (
    *(_demo, _train, _masks, _associate, _bake, _import, _evaluate, _report, _bench),
    *(_info, _check, _objects, _lookup, _query, _name, _config, _warm_up),
)

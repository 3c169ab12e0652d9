"""The command ``r5dgs objects``: list the objects of a run or scene, in a table and a picture."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from ... import errors, terminal
from .. import inputs, options, pictures

NAME = "objects"
SHORT = "list the objects of a run or scene, in a table and a picture"
LONG = "List ids, names and sizes of the objects of a run or scene, and draw a picture labelled with them."
EXAMPLE = "scene.r5dgs --legend legend.png"
PAGE = "user/objects.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("target", type=Path, metavar="RUN|SCENE", help="run folder or .r5dgs file")
    data = "data set in whose views pixels are counted (default: that of the run)"
    p.add_argument("--data", type=Path, metavar="DIR", help=data)
    legend = "write a picture of the scene labelled with ids and names"
    p.add_argument("--legend", type=Path, metavar="FILE.png", help=legend)
    futures = "print probabilities from N sampled futures with contacts"
    p.add_argument("--futures", type=int, metavar="N", help=futures)
    p.add_argument("--json", action="store_true", help="print JSON instead of the table")
    pictures.add_arguments(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"legend": args.legend, "futures": args.futures, "as_json": args.json}
    run_objects(args.target, args.data, **given, **pictures.values_of(args))


def run_objects(
    target: Path,
    data: Path | None = None,
    *,
    legend: Path | None = None,
    futures: int | None = None,
    camera: str | None = None,
    t: float | None = None,
    mode: str = "rigid",
    size: int | None = None,
    threads: int | None = None,
    as_json: bool = False,
) -> dict[str, Any]:
    """Print the table of a scene's objects, and optionally draw a picture labelled with them.

    Args:
        target: Run folder or ``.r5dgs`` file.
        data: Data set whose views are used to count pixels and whose masks are compared; that of the run if None.
        legend: PNG file of the picture, or None.
        camera: Name or number of the picture's camera; the one that shows most objects if None.
        t: Scene time of the picture; if None, the best of the first, middle and last observed time.
        mode: Playback mode past t_max.
        size: Pixels of the picture along its longer side.
        threads: Threads of the kernels; see `options.use_threads`.
        futures: Number of sampled futures for probabilities of contacts, or None.
        as_json: Print JSON instead of the table.

    Returns:
        The content printed by ``--json`` (`evaluation.object_table.to_json`).
    """
    pictures.check("--legend", legend, camera, t, size)
    inputs.check_mode(mode)
    _check_futures(futures)
    inputs.check_target(target, data)
    from ...evaluation import object_table
    from ...scene import sampling

    options.use_threads(threads)
    scene, dataset = inputs.open_target(target, data)
    inputs.check_mode(mode, scene, target)
    viewpoint = None
    if legend is not None:
        object_ids = [item.id for item in scene.objects if item.id > 0]
        viewpoint = pictures.best_viewpoint(scene, object_ids, camera, t, mode)
    views: list[Any] = object_table.own_views(scene) if dataset is None else []
    if dataset is not None:
        views = sampling.spread((*dataset.val, *dataset.test) or dataset.train, object_table.MAX_VIEWS)
    rows = object_table.measure(scene, views, mode)
    result = object_table.to_json(scene, rows, len(views))
    if futures is not None:
        from ...contact import odds

        result["futures"] = [dataclasses.asdict(row) for row in odds.of(scene, futures)]
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        _print(scene, rows, len(views), result.get("futures"))
    if legend is not None and viewpoint is not None:
        _draw_legend(legend, scene, viewpoint, mode, size, quiet=as_json)
    return result


def _check_futures(futures: int | None) -> None:
    if futures is not None and not 1 <= futures <= 10_000:
        raise errors.UsageError(f"--futures {futures}: expected 1 to 10000")


def _print(scene: Any, rows: Any, views: int, futures: list[dict[str, Any]] | None) -> None:
    """Print the tables of the objects, and probabilities if there are any."""
    from ...evaluation import object_table

    console = terminal.console()
    console.print(object_table.table(scene, rows, views))
    outlook = object_table.outlook_table(scene, rows)
    if outlook is not None:
        console.print(outlook)
    if futures is not None:
        _print_odds(futures)


def _print_odds(rows: list[dict[str, Any]]) -> None:
    """Print probabilities of contacts, one line for each object."""
    if not rows:
        print("no motion is predicted to touch anything")
    for row in rows:
        print(odds_text(row))


def odds_text(row: dict[str, Any]) -> str:
    """Return the probabilities of contacts of an object, the fields of `contact.odds.Odds`, in words."""
    hits = "".join(f", touches {name} first {share:.0%}" for name, share in row["hits"].items())
    turned = "" if row["turns_over"] is None else f", ends on another side than shown {row['turns_over']:.0%}"
    rest = f"comes to rest {row['rests']:.0%}, is off the ground at the end {row['leaves']:.0%}"
    return f"{row['name']}: {rest}{turned}{hits}"


def _draw_legend(path: Path, scene: Any, viewpoint: Any, mode: str, size: int | None, *, quiet: bool) -> None:
    """Write the picture of the labelled scene, and print its path unless ``quiet``."""
    from ...data import images
    from ...evaluation import legend

    images.write_png(path, legend.draw(scene, viewpoint, mode, longest=size))
    if not quiet:
        print(f"written: {path} (camera {viewpoint.camera.name}, t = {viewpoint.t:g})")

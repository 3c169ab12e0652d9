"""``r5dgs demo``: from the bundled images to a scene file, a contact sheet and a table, in one command."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from . import errors

NAME = "tabletop"


def bundled_data() -> Path:
    """Folder of the bundled data set: beside the sources, or inside the installed package.

    Raises:
        DatasetError: It is in neither place.
    """
    here = Path(__file__).resolve().parent
    for candidate in (here / "examples" / NAME, here.parent / "examples" / NAME):
        if (candidate / "transforms_train.json").exists():
            return candidate
    raise errors.DatasetError(f"the bundled data set 'examples/{NAME}' is missing; install r5dgs again from its source")


def run_demo(
    out: Path, *, config_path: Path | None, overrides: list[str], resume: bool, progress_kind: str
) -> dict[str, Any]:
    """Train, bake and measure the bundled data set.

    Writes into ``out``: the run, ``demo.r5dgs``, ``evaluation.json`` and ``contact_sheet.png``; prints the table.

    Returns:
        The evaluation.
    """
    from rich.console import Console

    from .data import dataset as datasets
    from .progress import make
    from .report import contact_sheet, evaluate, table
    from .scene import files, scene_file
    from .train import bake, config, run

    began = time.monotonic()
    data = bundled_data()
    settings = config.load(config_path, overrides)
    with make(progress_kind) as progress:
        trained = run.train(data, out, settings, resume=resume, progress=progress)
    dataset = datasets.read(data)
    scene = bake.bake(trained, dataset)
    scene_path = scene_file.write(scene, out / "demo.r5dgs")
    result = evaluate.evaluate(scene, dataset, train=scene.provenance["train"])
    files.write(out / "evaluation.json", json.dumps(result, indent=2).encode())
    sheet = contact_sheet.write(scene, dataset, out / "contact_sheet.png")
    if progress_kind != "json":
        Console().print(table.make(result))
        print(f"scene:         {scene_path}\ncontact sheet: {sheet}\ntable:         {out / 'evaluation.json'}")
        print(f"{time.monotonic() - began:.0f} s in all; open the scene in Blender: File > Import > R5DGS scene")
    return result

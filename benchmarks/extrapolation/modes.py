"""Extrapolation of many runs in one table: playback modes, motion models, and true poses as the oracle.

    python -m benchmarks.extrapolation modes RUN... [--split test] [--json FILE] [--markdown FILE]

Each run is baked with its data set. A run with dynamics of single Gaussians (`field`) is played in every mode, one
without (`tracks`) with each motion model. The table has the PSNR on the test images, which lie past t_max, and that of
the scene with true poses if the data set has them. Seeds of one scene and training have separate columns. Results:
docs/results/report.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.bake import bake
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data.dataset import Dataset
from r5dgs_core.error_vs_time import image_task, pose_task
from r5dgs_core.evaluation import evaluate
from r5dgs_core.playback import scene_player
from r5dgs_core.scene.scene import Scene
from r5dgs_core.train import run_folder

ORACLE = "true poses"


def refitted(scene: Scene, name: str) -> Scene:
    """The scene with one motion model for all bodies: with oscillation for swinging bodies, without for the others."""
    names = (name, pose_task.STEADY[name]) if name in pose_task.STEADY else (name,)
    groups = []
    for group in scene.groups:
        if group.role == "body" and np.any(scene.tracks.poses[group.id][:, 1:] != 0):
            group = dataclasses.replace(group, model=pose_task.fit_group(scene, group, names).model)
        groups.append(group)
    return dataclasses.replace(scene, groups=tuple(groups))


def measure(folder: Path, split: str) -> dict[str, Any]:
    """Measure a run: PSNR by mode or motion model, pose errors, and the share of true errors inside the band."""
    run = run_folder.open_run(folder)
    dataset = datasets.read(run.data())
    scene = bake.bake(run, dataset)
    ways: dict[str, evaluate.Move]
    if scene.dynamics is not None:
        ways = {mode: scene_player.Player(scene, mode).frame for mode in scene_player.modes(scene)}
    else:
        ways = {name: scene_player.Player(refitted(scene, name)).frame for name in pose_task.MODELS}
        ways["chosen"] = scene_player.Player(scene).frame
    views = dataset.views(split)
    oracle, why = image_task.true_move(scene, dataset, [view.t for view in views])
    if oracle is None:
        print(f"{folder}: no oracle: {why}")
    else:
        ways[ORACLE] = oracle
    found = {name: evaluate.measure_views(scene, views, move) for name, move in ways.items()}
    return {
        "run": folder.name,
        "scene": scene.name,
        "seed": run.config.train.seed,
        "training": _training(run),
        "psnr": {name: metrics["psnr"] for name, metrics in found.items()},
        "psnr_objects": {name: metrics["psnr_objects"] for name, metrics in found.items()},
        "objects": _objects(scene, dataset),
        "regrouping": [row["reason"] for row in scene.needs if row["name"] == "regrouping"],
    }


def _training(run: run_folder.Run) -> str:
    config = run.config
    if config.train.representation == "tracks":
        return "tracks"
    return config.field.variant + (", from tracks" if config.field.tracks_share > 0 else "")


def _objects(scene: Scene, dataset: Dataset) -> list[dict[str, Any]]:
    """Errors of poses at the last time, in diameters and degrees, and the share of errors outside the 95 % band."""
    rows, _ = pose_task.measure(scene, dataset.ground_truth, 1, "cpu")
    rows = [row for row in rows if row.error_kind in ("position", "rotation", "outside_band")]
    return [{"mode": row.mode, "method": row.method, "kind": row.error_kind, "error": row.error} for row in rows]


def markdown(found: list[dict[str, Any]]) -> str:
    """One table per kind of run, with a row per mode or motion model, a column per run, and the mean as last column."""
    parts = []
    for single in (True, False):
        runs = [r for r in found if (r["training"] == "tracks") != single]
        if not runs:
            continue
        names = list(dict.fromkeys(name for r in runs for name in r["psnr"]))
        heads = [f"{r['scene']} {r['training']}" + (f" seed {r['seed']}" if r["seed"] else "") for r in runs]
        lines = [
            f"| {'mode' if single else 'motion model'} | {' | '.join(heads)} | mean |",
            f"|---|{'---:|' * (len(runs) + 1)}",
        ]
        for name in names:
            values = [r["psnr"].get(name) for r in runs]
            mean = f"{np.mean(values):.2f}" if all(v is not None for v in values) else "-"
            cells = ["-" if v is None else f"{v:.2f}" for v in values]
            lines.append(f"| {name} | {' | '.join(cells)} | {mean} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--split", default="test")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    found = []
    for folder in args.runs:
        found.append(measure(folder, args.split))
        print(f"{folder}: " + ", ".join(f"{name} {value:.2f}" for name, value in found[-1]["psnr"].items()), flush=True)
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    text = markdown(found)
    print(text)
    if args.markdown:
        args.markdown.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

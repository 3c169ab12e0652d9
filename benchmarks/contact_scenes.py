"""Futures with contacts of rendered scenes, simulated by another engine: Bullet.

    python -m benchmarks.contact_scenes DATA RUNS [--scenes 0 1 ...] [--seed N] [--set SECTION.KEY=VALUE] [--json FILE]

DATA holds the data sets of ``examples/build_collisions.py`` in folders 00 to 11; missing ones are skipped. Each is
trained once into a folder of RUNS, unless it is there, and baked with and without contacts. Scenes 8 to 11 are for
judging: choose nothing by them. Columns, without contacts -> with contacts:

    psnr       PSNR on object pixels of the split test
    end        error of an object's place at t = 1, in sizes
    turn       error of its rotation there, degrees
    friction, restitution   fitted, with a factor or a difference of one standard deviation, and the true ones
    s          processor seconds of baking
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.bake import bake
from r5dgs_core.config import config
from r5dgs_core.contact import scene_bodies, scene_future
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data.dataset import Dataset
from r5dgs_core.evaluation import evaluate, ground_truth_poses, metrics
from r5dgs_core.playback import scene_player
from r5dgs_core.render import warm_up
from r5dgs_core.scene.scene import Scene
from r5dgs_core.train import run, run_folder

SETTINGS = ("train.iterations=1000", "train.probe_every=0", "identity.iterations=20")  # small images need few steps
DEVELOPED = range(8)  # scenes by which choices were made


def prepare(data: Path, folder: Path, settings: config.Config) -> run_folder.Run:
    """Train a data set into a folder, unless it is there."""
    return run_folder.open_run(folder) if folder.exists() else run.train(data, folder, settings)


def baked(trained: run_folder.Run, dataset: Dataset, switch: str) -> tuple[Scene, float]:
    """Bake with contacts on or off. Returns the scene and the processor seconds."""
    chosen = dataclasses.replace(trained, config=trained.config.override([f"needs.contact={switch}"]))
    began = time.process_time()
    scene = bake.bake(chosen, dataset)
    return scene, time.process_time() - began


def scored(scene: Scene, dataset: Dataset) -> dict[str, Any]:
    """PSNR on object pixels of test, and the errors of each object at the end."""
    assert dataset.ground_truth is not None
    move = scene_player.Player(scene).frame
    found: dict[str, Any] = {"psnr": evaluate.measure_views(scene, dataset.test, move)["psnr_objects"], "objects": {}}
    for body in ground_truth_poses.bodies(scene, dataset.ground_truth):
        predicted = ground_truth_poses.motion(scene, [body.group], body.times)[0]
        places, turns = metrics.pose_errors(predicted, body.motion, body.group.pivot)
        found["objects"][body.name] = {"end": float(places[-1] / body.size), "turn": float(turns[-1])}
    return found


def materials(scene: Scene) -> dict[str, dict[str, float]]:
    """Fitted friction and restitution of each object, with deviations of log friction and of restitution."""
    predicted = scene_future.predict(scene_bodies.without_contacts(scene))
    made, found = predicted.world, {}
    if made is None:
        return found
    for number, (_, estimate) in made.fits.items():
        deviations = np.sqrt(np.diag(estimate.covariance)[12:])
        e = estimate.material.restitution
        found[made.bodies[number].name] = {
            "friction": estimate.material.friction,
            "friction_deviation": float(deviations[0]),
            "restitution": e,
            "restitution_deviation": float(deviations[1] * e * (1 - e)),
        }
    return found


def study(data: Path, folder: Path, settings: config.Config) -> dict[str, Any]:
    """Train, bake and measure a scene."""
    dataset = datasets.read(data)
    trained = prepare(data, folder, settings)
    off, seconds_off = baked(trained, dataset, "off")
    on, seconds_on = baked(trained, dataset, "on")
    truth = json.loads((data / "material.json").read_text())
    return {
        "scene": truth["name"],
        "off": scored(off, dataset) | {"seconds": seconds_off},
        "on": scored(on, dataset) | {"seconds": seconds_on},
        "kinds": {item.name: on.groups[item.id].model.kind for item in on.objects if item.id},
        "fitted": materials(on),
        "true": {one["name"]: (one["friction"], one["restitution"]) for one in truth["bodies"]},
        "told": truth["told"],
    }


def lines(row: dict[str, Any]) -> str:
    """Rows of the table of one scene, one per object."""
    found = []
    for name, before in row["off"]["objects"].items():
        after, fitted = row["on"]["objects"][name], row["fitted"].get(name)
        cells = [row["scene"], name, _both("{:.2f}", row["off"]["psnr"], row["on"]["psnr"])]
        cells += [_both("{:.2f}", before["end"], after["end"]), _both("{:.0f}", before["turn"], after["turn"])]
        for k, (key, band) in enumerate((("friction", "x {:.2f}"), ("restitution", "+- {:.2f}"))):
            true = f"{row['true'][name][k]:.2f}" + ("" if key in row["told"] else " (not seen)")
            if fitted is None:
                cells.append(f"- / {true}")
                continue
            deviation = fitted[f"{key}_deviation"]
            width = band.format(np.exp(deviation) if key == "friction" else deviation)
            cells.append(f"{fitted[key]:.2f} {width} / {true}")
        cells.append(_both("{:.1f}", row["off"]["seconds"], row["on"]["seconds"]))
        found.append("| " + " | ".join(cells) + " |")
    return "\n".join(found)


def _both(form: str, before: float, after: float) -> str:
    return f"{form.format(before)} -> {form.format(after)}"


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Gain of the PSNR, and end errors over all objects."""
    gains = [row["on"]["psnr"] - row["off"]["psnr"] for row in rows]
    ends = {key: [one["end"] for row in rows for one in row[key]["objects"].values()] for key in ("off", "on")}
    return {
        "scenes": len(rows),
        "psnr_gain": float(np.mean(gains)),
        "psnr_gain_least": float(np.min(gains)),
        "end_off": float(np.median(ends["off"])),
        "end_on": float(np.median(ends["on"])),
        "within_10_percent": float(np.mean(np.array(ends["on"]) <= 0.1)),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--scenes", nargs="+", type=int, default=list(DEVELOPED))
    parser.add_argument("--seed", type=int, default=0, help="seed of the training")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    settings = config.load(None, [*SETTINGS, f"train.seed={args.seed}", *args.set])
    print("| scene | object | psnr | end | turn | friction / true | restitution / true | s |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for number in args.scenes:
        data = args.data / f"{number:02d}"
        if data.exists():
            rows.append(study(data, args.runs / f"{number:02d}_{args.seed}", settings))
            print(lines(rows[-1]), flush=True)
    if rows:
        print(json.dumps(summary(rows), indent=1))
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1, default=float) + "\n")


if __name__ == "__main__":
    main()

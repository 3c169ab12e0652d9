"""Tracks and futures of trained scenes: error of every object, seen and predicted.

    python -m benchmarks.futures rendered [--scenes NAME ...] [--seeds 0 1] [--set SECTION.KEY=VALUE] [--json FILE]

Renders each scene of `rendered_scenes`, trains and bakes it. Columns, per object:

    place      largest error of its place at the observed times, in % of its size
    turn       median and largest error of its rotation there, degrees
    future     error of its place at t = 1 in % of its size, and of its rotation, degrees
    warning    reason why its motion is reported as not predictable, if it is

and per scene the PSNR of val and of test, of test with true poses, and the processor time of the training.
The last lines sum up the times after t_max, where the error is that over the body's surface: the share of errors inside
the 95 % band, the half widths of the band, and the flags of bodies whose error at t = 1 is above 20 % of their size.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data.dataset import Dataset
from r5dgs_core.error_vs_time import image_task
from r5dgs_core.evaluation import evaluate, ground_truth_poses, metrics
from r5dgs_core.evaluation.ground_truth_poses import Body
from r5dgs_core.playback import scene_player
from r5dgs_core.render import warm_up
from r5dgs_core.scene import predictability
from r5dgs_core.scene.scene import Scene

from ..training import timed_training
from . import rendered_scenes, scoring

SETTINGS = (  # small images need few Gaussians
    "train.iterations=1000",
    "train.probe_every=0",
    "identity.iterations=20",
    "init.background_points=1500",
    "init.object_points=300",
    "init.shadow_points=20",
    "init.sweep_depths=48",
)


def object_rows(scene: Scene, dataset: Dataset) -> list[dict[str, Any]]:
    """Errors of each object of a scene with true poses."""
    assert dataset.ground_truth is not None
    rows = []
    for body in ground_truth_poses.bodies(scene, dataset.ground_truth):
        predicted = ground_truth_poses.motion(scene, [body.group], body.times)[0]
        places, turns = metrics.pose_errors(predicted, body.motion, body.group.pivot)
        first, last = body.group.seen or (-np.inf, np.inf)
        seen = (body.times <= min(scene.t_max, last) + 1e-9) & (body.times >= first - 1e-9)
        after = body.times > scene.t_max + 1e-9
        rows.append(
            {
                "object": body.name,
                "place": float(100 * places[seen].max() / body.size),
                "turn": float(np.median(turns[seen])),
                "worst_turn": float(turns[seen].max()),
                "future": float(100 * places[-1] / body.size),
                "future_turn": float(turns[-1]),
                "warning": body.group.history.warning(predictability.horizon(scene)),
                **later_errors(body, body.times[after], places[after], turns[after]),
            }
        )
    return rows


def later_errors(body: Body, times: np.ndarray, places: np.ndarray, turns: np.ndarray) -> dict[str, Any]:
    """Errors over a body's surface past t_max and half widths of its band, in % of its size, and its flag.

    Args:
        body: The body.
        times: Times past t_max. [H]
        places: Position errors there, world units. [H]
        turns: Rotation errors there, degrees. They count if the images determine the rotation. [H]
    """
    band = body.group.history.band
    assert band is not None
    angles = np.radians(turns) if body.turn_seen else 0.0
    return {
        "errors": scoring.surface_error(places, angles, body.size).tolist(),
        "half_widths": scoring.half_widths(band, times, body.size).tolist(),
        "flagged": scoring.flagged(band, times[-1]),
    }


def coverage(rows: list[dict[str, Any]]) -> str:
    """Coverage of the bands and quality of the flags over all bodies of all scenes, in words."""
    bodies = [one for row in rows for one in row["objects"]]
    errors, half = (np.concatenate([one[key] for one in bodies]) for key in ("errors", "half_widths"))
    widths = np.array([one["half_widths"][-1] for one in bodies])
    failed = np.array([one["errors"][-1] > scoring.BAD for one in bodies])
    flagged = np.array([one["flagged"] for one in bodies])
    alarms = (~failed & flagged).sum()
    return (
        f"{len(errors)} body-times, {100 * np.mean(errors <= half):.1f} % inside the band; half width at t = 1: median "
        f"{np.median(widths):.1f} %, 90 % quantile {np.quantile(widths, 0.9):.1f} % of the size\n"
        f"{len(bodies)} bodies, {failed.sum()} with an error above {scoring.BAD:g} % at t = 1, "
        f"{(failed & flagged).sum()} of them flagged; {alarms} of the other {(~failed).sum()} flagged"
    )


def scene_row(scene: Scene, dataset: Dataset) -> dict[str, float]:
    """PSNR of a scene, with its own motion and with true poses."""
    play = scene_player.Player(scene).frame
    oracle, why = image_task.true_move(scene, dataset, [view.t for view in dataset.test])
    assert oracle is not None, why
    plan = {"val": (dataset.val, play), "test": (dataset.test, play), "oracle": (dataset.test, oracle)}
    return {name: float(evaluate.measure_views(scene, views, move)["psnr"]) for name, (views, move) in plan.items()}


def measure(data: Path, settings: config.Config) -> dict[str, Any]:
    """Train a data set, and measure the scene."""
    dataset = datasets.read(data)
    scene, seconds = timed_training.train(data, settings)
    return {**scene_row(scene, dataset), "seconds": seconds, "objects": object_rows(scene, dataset)}


def _lines(name: str, seed: int, found: dict[str, Any]) -> str:
    """Rows of the table of one scene, one per object."""
    quality = " | ".join(f"{found[key]:.2f}" for key in ("val", "test", "oracle"))
    return "\n".join(
        f"| {name} | {seed} | {one['object']} | {one['place']:.1f} | {one['turn']:.1f}, {one['worst_turn']:.1f} "
        f"| {one['future']:.1f} | {one['future_turn']:.1f} | {quality} | {found['seconds']:.0f} | {one['warning']} |"
        for one in found["objects"]
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Tracks and futures of trained scenes.")
    parser.add_argument("--scenes", nargs="+", choices=rendered_scenes.SCENES, default=list(rendered_scenes.SCENES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--data", type=Path, help="keep the data sets in this folder, and use those that are there")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    settings = config.load(None, [*SETTINGS, *args.set])
    print("| scene | seed | object | place % | turn, worst | future % | turn | val | test | oracle | s | warning |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in args.scenes:
            for seed in args.seeds:
                data = (args.data or Path(folder)) / f"{name}_{seed}"
                if not data.exists():
                    rendered_scenes.write(data, name, seed)
                found = measure(data, settings)
                rows.append({"scene": name, "seed": seed, **found})
                print(_lines(name, seed, found), flush=True)
    print(coverage(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()

"""From videos to a scene: wrong cameras against exact ones.

    python -m benchmarks.cameras dirty [--scenes NAME ...] [--seeds N] [--size 256] [--cameras 8] [--frames 25]
        [--rows NAME ...] [--set KEY=VALUE] [--data FOLDER] [--json FILE]

Writes the recordings of `rendered_recordings`, prepares each with `r5dgs prepare`, and trains it:

    clean           exact cameras, refinement off
    clean-refined   exact cameras, refinement as by default
    dirty           wrong cameras, clocks compared by motion, refinement as by default
    dirty-clocks    the same, but clocks are not compared before training
    dirty-given     wrong cameras, clocks not compared, refinement off

``psnr`` and ``psnr_aligned`` are those of pictures of other cameras without distortion, blur or compression, at times
between the frames. ``px`` is the distance of the training cameras from the true ones up to a similarity of the world
(rms), ``ms`` the largest error of a clock up to a common shift. Results: docs/results/captures.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.cli.commands import prepare
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate
from r5dgs_core.prepare.plan import Plan
from r5dgs_core.render import warm_up
from r5dgs_core.scene import camera_correction
from r5dgs_core.train.refinement.refinement import PARTS

from ..futures import rendered_scenes
from ..training import timed_training
from . import disturbed, rendered_recordings
from .rendered_recordings import Recording, Truth

OFF = tuple(f"needs.{part}=off" for part in PARTS)
ROWS = {  # recording, comparison of clocks, settings
    "clean": ("clean", "none", OFF),
    "clean-refined": ("clean", "none", ()),
    "dirty": ("dirty", "auto", ()),
    "dirty-clocks": ("dirty", "none", ()),
    "dirty-given": ("dirty", "none", OFF),
}
VIEWS, TIMES = 3, 5  # held-out cameras, and their times


def prepared(truth: Truth, recording: Recording, sync: str, out: Path) -> Plan:
    """Prepare a recording with its masks, and add the held-out pictures."""
    plan = prepare.run_prepare(recording.folder, out, masks=str(recording.masks), sync=sync, hold_out={"horizon": 0.0})
    zero = min(times[0] for times in plan.choice.times)
    unit = plan.timeline.seconds_per_unit
    rendered_recordings.write_held_out(truth, out, zero, unit, VIEWS, TIMES)
    return plan


def measure(truth: Truth, recording: Recording, plan: Plan, settings: config.Config) -> dict[str, Any]:
    """Train a prepared data set, and measure the scene, its cameras and clocks."""
    data = Path(plan.request.out)
    dataset = datasets.read(data)
    scene, seconds = timed_training.train(data, settings)
    found = evaluate.evaluate(scene, dataset, splits=("val",), align=True)["splits"]["val"]["rigid"]
    record = scene.provenance.get("cameras", {})
    corrections = {n: camera_correction.from_dict(c) for n, c in record.get("corrections", {}).items()}
    given = disturbed.training_cameras(dataset)
    true = {
        name: dataclasses.replace(given[name], T_cam_world=camera.T_cam_world)
        for name, camera in zip(truth.rig.names, truth.rig.cameras, strict=True)
    }
    now = {name: corrections[name].camera(camera) if corrections else camera for name, camera in given.items()}
    clocks = np.array([offset.seconds for offset in plan.offsets])
    later = clocks + [
        corrections[name].time * plan.timeline.seconds_per_unit if corrections else 0.0 for name in truth.rig.names
    ]
    return {
        "psnr": found["psnr"],
        "psnr_aligned": found["psnr_aligned"],
        "px_given": disturbed.distance(given, true)[1],
        "px": disturbed.distance(now, true)[1],
        "ms_given": clock_error(np.zeros(len(clocks)), recording.offsets),
        "ms_prepared": clock_error(clocks, recording.offsets),
        "ms": clock_error(later, recording.offsets),
        "ms_rms": clock_error(later, recording.offsets, largest=False),
        "refined": record.get("refined", []),
        "sizes": record.get("sizes"),
        "gaussians": len(scene.gaussians.means),
        "cpu_seconds": seconds,
    }


def clock_error(found: np.ndarray, true: np.ndarray, largest: bool = True) -> float:
    """Return the largest (or rms) error of offsets up to a common shift, ms. [C] each"""
    off = 1e3 * (found - true)
    off = np.abs(off - off.mean())
    return float(off.max() if largest else np.sqrt(np.mean(off**2)))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=rendered_scenes.SCENES, default=["sliders", "balls"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--frames", type=int, default=25)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--data", type=Path, help="keep the recordings in this folder, and use those that are there")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    rows = []
    print(f"{'scene':>10} {'seed':>4} {'':>13} {'psnr':>6} {'aligned':>7} {'px':>6} {'ms':>6} {'cpu':>5}")
    with tempfile.TemporaryDirectory() as folder:
        for scene in args.scenes:
            for seed in args.seeds:
                truth = rendered_recordings.make(scene, seed, args.size, args.cameras, args.frames)
                place = (args.data or Path(folder)) / f"{scene}_{seed}"
                for name in args.rows:
                    kind, sync, extra = ROWS[name]
                    recording = rendered_recordings.recorded(truth, place / kind, seed)
                    with tempfile.TemporaryDirectory() as room:
                        plan = prepared(truth, recording, sync, Path(room) / "data")
                        settings = config.load(None, [f"train.seed={seed}", *args.set, *extra])
                        row = {"scene": scene, "seed": seed, "row": name, **measure(truth, recording, plan, settings)}
                    rows.append(row)
                    cells = f"{row['psnr']:>6.2f} {row['psnr_aligned']:>7.2f} {row['px']:>6.3f} {row['ms']:>6.2f}"
                    named = f"{scene:>10} {seed:>4} {name:>13}"
                    print(f"{named} {cells} {row['cpu_seconds']:>5.0f} {row['refined']}", flush=True)
                    if args.json:
                        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

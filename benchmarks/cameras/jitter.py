"""Quality of training with wrong poses and colours of the cameras, refined or not.

    python -m benchmarks.cameras jitter DATA [--pixels 0.5 2] [--gain 0.1] [--seeds 1] [--set KEY=VALUE] [--json FILE]

Each row is a run on a copy of the data set: with the given cameras, with each jitter of the poses and with each gain of
the colours, refined (as by default) and not (``--both``). ``psnr`` is measured with the true held-out cameras,
``psnr_aligned`` after they were aligned to the scene. ``error`` is the distance of the training cameras from the true
ones up to a similarity of the world. Results: docs/results/captures.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.bake import bake
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate
from r5dgs_core.render import warm_up
from r5dgs_core.scene import camera_correction
from r5dgs_core.train import run
from r5dgs_core.train.refinement.refinement import PARTS

from . import disturbed

OFF = tuple(f"needs.{part}=off" for part in PARTS)


def measure(data: Path, pixels: float, gain: float, settings: config.Config, seed: int) -> dict[str, Any]:
    """Train on a copy of the data set with wrong cameras, and measure the scene and its cameras."""
    true = datasets.read(data)
    errors = disturbed.draw_errors(true, pixels, gain, np.random.default_rng(100 + seed))
    with tempfile.TemporaryDirectory() as folder:
        copy = data
        if pixels or gain:
            copy = disturbed.write(data, errors, Path(folder) / data.resolve().name)
        began = time.process_time()
        trained = run.train(copy, Path(folder) / "run", settings.override([f"train.seed={seed}"]))
        seconds = time.process_time() - began
        scene = bake.bake(trained)
        found = evaluate.evaluate(scene, true, align=True)["splits"]
        # held-out views of a training camera have its true pose, so its corrections do not apply to them
        unknown = {**scene.provenance, "cameras": {**scene.provenance.get("cameras", {}), "corrections": {}}}
        aligned = evaluate.evaluate(dataclasses.replace(scene, provenance=unknown), true, align=True)["splits"]
    record = scene.provenance.get("cameras", {})
    corrections = {n: camera_correction.from_dict(c) for n, c in record.get("corrections", {}).items()}
    given = disturbed.training_cameras(true)
    wrong = {name: errors[name].camera(camera) for name, camera in given.items()}
    now = {name: corrections[name].camera(camera) if corrections else camera for name, camera in wrong.items()}
    before, after = disturbed.distance(wrong, given), disturbed.distance(now, given)
    row = {"pixels": pixels, "gain": gain, "seed": seed, "refined": record.get("refined", []), "cpu_seconds": seconds}
    row |= {"sizes": record.get("sizes"), "error_before": before[1], "error": after[1], "error_raw": after[0]}
    for split, modes in found.items():
        row |= {split: modes["rigid"]["psnr"], f"{split}_aligned": aligned[split]["rigid"]["psnr_aligned"]}
    return row


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Measure training with wrong cameras.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--pixels", type=float, nargs="*", default=[0.0, 0.5, 2.0])
    parser.add_argument("--gain", type=float, nargs="*", default=[])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--both", action="store_true", help="also train without refinement")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    rows = []
    names = f"{'px':>4} {'gain':>5} {'seed':>4} {'':>9}"
    print(f"{names} {'val':>6} {'aligned':>7} {'test':>6} {'aligned':>7} {'px left':>7} {'cpu':>5}")
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for pixels, gain in [*((p, 0.0) for p in args.pixels), *((0.0, g) for g in args.gain)]:
            for how, extra in (("refined", ()), ("as given", OFF))[: 1 + args.both]:
                settings = config.load(None, [*args.set, *extra])
                row = {"how": how, **measure(args.data, pixels, gain, settings, seed)}
                rows.append(row)
                cells = f"{row['val']:>6.2f} {row['val_aligned']:>7.2f} {row['test']:>6.2f} {row['test_aligned']:>7.2f}"
                named = f"{pixels:>4g} {gain:>5g} {seed:>4} {how:>9}"
                print(f"{named} {cells} {row['error']:>7.3f} {row['cpu_seconds']:>5.0f} {row['refined']}", flush=True)
                if args.json:
                    args.json.write_text(json.dumps({"data": args.data.resolve().name, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()

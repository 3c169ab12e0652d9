"""Quality between the observed times.

    python -m benchmarks.training held_out_times DATA [--every 3] [--offset 1] [--sparse] [--reference] [--json FILE]

Every third observed time, except the first and last, is removed from the training split in a copy of the data set; with
``--sparse`` all but every third are. After a run on the copy, the scene is compared at observed and at held-out times,
with novel cameras (val) and with training cameras (train). ``--reference`` also trains on the whole data set; the
difference at held-out times is the loss of the interpolation in time. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import shutil
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate
from r5dgs_core.render import warm_up
from r5dgs_core.scene.scene import Scene

from . import timed_training


def held_out(times: Sequence[float], every: int, offset: int, sparse: bool = False) -> list[float]:
    """Times to hold out: every ``every``-th from index ``offset`` on, or (sparse) the others; never the two ends."""
    found = sorted(set(times))
    return [t for k, t in enumerate(found) if (k % every == offset % every) != sparse and 0 < k < len(found) - 1]


def derive(data: Path, removed: Collection[float], folder: Path) -> Path:
    """Copy a data set without the training frames at the ``removed`` times; returns its folder."""
    if not (data / "transforms_train.json").is_file():
        raise SystemExit(
            f"{data / 'transforms_train.json'}: expected the camera file of the training split, found none; times of a "
            "COLMAP data set cannot be held out by this benchmark"
        )
    copy = folder / data.resolve().name
    shutil.copytree(data, copy)
    path = copy / "transforms_train.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    for part in [content, *content.get("data", {}).values()]:
        if "frames" in part:
            if any("time" not in frame for frame in part["frames"]):
                raise SystemExit(f"{path}: expected a time at every frame; without them none can be held out")
            part["frames"] = [f for f in part["frames"] if not _among(float(f["time"]), removed)]
    path.write_text(json.dumps(content), encoding="utf-8")
    return copy


def measure(scene: Scene, dataset: datasets.Dataset, removed: Collection[float]) -> list[dict[str, Any]]:
    """Quality by cameras (val, train) and times (observed, held out); objects' pixels apart."""
    observed = {v.t for v in dataset.train if not _among(v.t, removed)}
    rows = []
    for split in ("val", "train"):
        for kind, wanted in (("observed", observed), ("held out", removed)):
            views = tuple(v for v in dataset.views(split) if _among(v.t, wanted))
            if not views:
                continue
            shown = dataclasses.replace(dataset, val=views)
            found = evaluate.evaluate(scene, shown, splits=("val",))["splits"]["val"]["rigid"]
            keys = ("images", "psnr", "psnr_objects", "ssim", "miou")
            rows.append({"cameras": split, "times": kind, **{key: found[key] for key in keys}})
    return rows


def _among(t: float, times: Collection[float]) -> bool:
    return bool(np.isclose(list(times), t, rtol=0, atol=1e-6).any()) if times else False


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Measure the quality between the observed times.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--offset", type=int, default=1)
    parser.add_argument("--sparse", action="store_true", help="remove the others instead")
    parser.add_argument("--reference", action="store_true", help="train on the whole data set too")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    settings = config.load(None, args.set)
    dataset = datasets.read(args.data)
    removed = held_out([v.t for v in dataset.train], args.every, args.offset, args.sparse)
    if not removed:
        raise SystemExit(f"{args.data}: expected more than two observed times to hold some out")
    rows, seconds = [], {}
    with tempfile.TemporaryDirectory() as folder:
        runs = {"without them": derive(args.data, removed, Path(folder))}
        if args.reference:
            runs["with them"] = args.data
        print(f"{len(removed)} times held out: {', '.join(f'{t:g}' for t in removed)}")
        print(f"{'trained':>12} {'cameras':>8} {'times':>8} {'images':>6} {'dB':>6} {'objects':>7} {'SSIM':>6}")
        for name, data in runs.items():
            scene, seconds[name] = timed_training.train(data, settings)
            for row in measure(scene, dataset, removed):
                rows.append({"trained": name, **row})
                psnr, objects, ssim = (math.nan if row[k] is None else row[k] for k in ("psnr", "psnr_objects", "ssim"))
                print(
                    f"{name:>12} {row['cameras']:>8} {row['times']:>8} {row['images']:>6} {psnr:>6.2f} {objects:>7.2f} "
                    f"{ssim:>6.4f}",
                    flush=True,
                )
    if args.json:
        result = {"data": dataset.name, "held_out": removed, "cpu_seconds": seconds, "rows": rows}
        args.json.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()

"""Quality against training time: complete runs of several lengths on one data set, measured on held-out views.

    python -m benchmarks.training curve DATA [--iterations 500 1000 2000 4000 6000] [--json FILE] [--plot FILE]

Each point is a separate run with a schedule scaled to its length. Seconds are wall time of training and identities.
Rows have the shape of ``r5dgs report``. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from r5dgs_core.bake import bake
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.evaluation import evaluate
from r5dgs_core.render.warm_up import warm_up
from r5dgs_core.train import run


def measure(data: Path, iterations: int, overrides: list[str]) -> dict[str, Any]:
    """Train once and measure: seconds, Gaussians, and the metrics of val and test."""
    settings = config.load(None, [f"train.iterations={iterations}", *overrides])
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        trained = run.train(data, Path(folder) / "run", settings)
        seconds = time.perf_counter() - began
        dataset = datasets.read(data)
        scene = bake.bake(trained, dataset)
    result = evaluate.evaluate(scene, dataset)
    metrics = {split: modes["rigid"] for split, modes in result["splits"].items()}
    return {"iterations": iterations, "seconds": seconds, "gaussians": len(scene.gaussians.means), **metrics}


def to_rows(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the report. A point is on the Pareto front if no faster point is at least as good."""
    rows = []
    for split in ("val", "test"):
        best = -float("inf")
        for point in sorted(points, key=lambda p: p["seconds"]):
            psnr = point.get(split, {}).get("psnr")
            if psnr is None:
                continue
            rows.append(
                {
                    "task": f"training, {split}",
                    "mode": "rigid",
                    "method": "tracks",
                    "setting": f"{point['iterations']} iterations",
                    "error_kind": "psnr",
                    "error": psnr,
                    "ms": 1000 * point["seconds"],
                    "pareto": psnr > best,
                }
            )
            best = max(best, psnr)
    return rows


def plot(points: list[dict[str, Any]], title: str, path: Path) -> None:
    """PSNR of val and test over seconds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), constrained_layout=True)
    for split in ("val", "test"):
        found = [(p["seconds"], p[split]["psnr"], p["iterations"]) for p in points if p.get(split)]
        axes.plot([f[0] for f in found], [f[1] for f in found], "o-", label=split)
        for seconds, psnr, count in found:
            axes.annotate(str(count), (seconds, psnr), textcoords="offset points", xytext=(4, -11), fontsize=8)
    axes.set(xlabel="training, seconds", ylabel="PSNR, dB", title=title)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--iterations", type=int, nargs="+", default=[500, 1000, 2000, 4000, 6000])
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    warm_up()
    points = []
    print(f"{'iterations':>10} {'seconds':>8} {'Gaussians':>9} {'val dB':>7} {'test dB':>7}")
    for count in args.iterations:
        point = measure(args.data, count, args.set)
        points.append(point)
        val, test = (point.get(split, {}).get("psnr") for split in ("val", "test"))
        print(f"{count:>10} {point['seconds']:>8.1f} {point['gaussians']:>9} {val:>7.2f} {test:>7.2f}", flush=True)
    if args.json:
        args.json.write_text(json.dumps({"points": points, "rows": to_rows(points)}, indent=2))
    if args.plot:
        plot(points, f"{args.data.name}: error against run time of training", args.plot)


if __name__ == "__main__":
    main()

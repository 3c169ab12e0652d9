"""Processor time of one training step, of tracks and of the field, on the same data and Gaussians.

    python -m benchmarks.training step DATA [--gaussians 12000] [--steps 200] [--json FILE]

Each representation is trained up to the given number of Gaussians, with accelerated growth and all observed times from
the first step on. Then steps without growth are timed with warm kernels: median and minimum on one thread, from posing
to the optimizer. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import trainer, warm_up

VARIANTS = {
    "tracks": [],
    "tracks, identities beside": ["identity.training='detached'"],
    "tracks, harmonics of degree 3": ["train.sh_degree=3"],
    "field": ["train.representation='field'", "field.place_steps=20", "field.trd_steps=0"],
    "field, through the TRD": [
        "train.representation='field'",
        "field.place_steps=20",
        "field.trd_steps=0",
        "field.trd_share=1.0",
    ],
}


def settings(overrides: list[str], gaussians: int) -> config.Config:
    """Configuration of a run that quickly grows to a number of Gaussians and uses all times from its first step on."""
    grown = ["densify.share=1.0", "densify.gradient=1e-6", f"densify.max_gaussians={gaussians}", "densify.start=20"]
    at_once = ["train.iterations=100000", "densify.every=20", "curriculum.first=0", "curriculum.grow=0"]
    return config.load(None, [*at_once, *grown, *overrides])


def measure(dataset: datasets.Dataset, overrides: list[str], gaussians: int, steps: int) -> dict[str, Any]:
    """Grow to a number of Gaussians, then time steps, in milliseconds."""
    run = trainer.Trainer(dataset, settings(overrides, gaussians))
    while len(run.gaussians) < 0.98 * gaussians and run.iteration < 1000:
        run.step()
    run.densifier.observe = lambda *_: None  # type: ignore[method-assign]
    times = []
    for _ in range(steps):
        began = time.process_time()
        run.step()
        times.append(1e3 * (time.process_time() - began))
    return {"gaussians": len(run.gaussians), "median_ms": statistics.median(times), "least_ms": min(times)}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--gaussians", type=int, default=12000)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    dataset = datasets.read(args.data)
    rows = []
    print(f"{'':32} {'Gaussians':>9} {'median ms':>9} {'least ms':>9}")
    for name in args.variants:
        row = {"variant": name, **measure(dataset, VARIANTS[name], args.gaussians, args.steps)}
        rows.append(row)
        print(f"{name:32} {row['gaussians']:>9} {row['median_ms']:>9.2f} {row['least_ms']:>9.2f}", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()

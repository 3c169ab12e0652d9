"""Time of one training step, of tracks and of the field, on the same data and Gaussians.

    python -m benchmarks.training step DATA [--device cpu] [--gaussians 12000] [--steps 200] [--json FILE]

Each representation is trained up to the given number of Gaussians, with accelerated growth and all observed times from
the first step on. Then steps without growth are timed with warm kernels: median and minimum on one thread, from posing
to the optimizer. On a CPU these are processor times. On a GPU they are wall times of ten steps, divided by ten; kernels
and their time per step come from torch's profiler, and *waits* are the lines of this package at which the processor
waits for the GPU. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import torch

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
    "field, the paper's networks": [
        "train.representation='field'",
        "field.place_steps=20",
        "field.trd_steps=0",
        "field.size='complex'",
    ],
}
BLOCK = 10  # steps between readings of the clock on a GPU


def settings(overrides: list[str], gaussians: int) -> config.Config:
    """Configuration of a run that quickly grows to a number of Gaussians and uses all times from its first step on."""
    grown = ["densify.share=1.0", "densify.gradient=1e-6", f"densify.max_gaussians={gaussians}", "densify.start=20"]
    at_once = ["train.iterations=100000", "densify.every=20", "curriculum.first=0", "curriculum.grow=0"]
    return config.load(None, [*at_once, *grown, *overrides])


def measure(dataset: datasets.Dataset, overrides: list[str], gaussians: int, steps: int, device: str) -> dict[str, Any]:
    """Grow to a number of Gaussians, then time steps, in milliseconds."""
    run = trainer.Trainer(dataset, settings([*overrides, f"train.device='{device}'"], gaussians))
    while len(run.gaussians) < 0.98 * gaussians and run.iteration < 1000:
        run.step()
    run.densifier.observe = run.densifier.after_step = lambda *_: None  # type: ignore[method-assign]
    if run.device.type == "cuda":
        return {"gaussians": len(run.gaussians), **on_gpu(run, steps)}
    times = []
    for _ in range(steps):
        began = time.process_time()
        run.step()
        times.append(1e3 * (time.process_time() - began))
    return {"gaussians": len(run.gaussians), "median_ms": statistics.median(times), "least_ms": min(times)}


def on_gpu(run: trainer.Trainer, steps: int) -> dict[str, Any]:
    """Time steps on a GPU, and list its kernels and the waits of the processor."""
    times = []
    for _ in range(30):  # captures graphs
        run.step()
    for _ in range(max(2, steps // BLOCK)):
        torch.cuda.synchronize()
        began = time.perf_counter()
        for _ in range(BLOCK):
            run.step()
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - began) / BLOCK)
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(BLOCK):
            run.step()
        torch.cuda.synchronize()
    cuda = torch.autograd.DeviceType.CUDA
    kernels = [event for event in profile.events() if event.device_type == cuda]
    return {
        "median_ms": statistics.median(times),
        "least_ms": min(times),
        "kernels": len(kernels) / BLOCK,
        "kernel_ms": sum(event.self_device_time_total for event in kernels) / 1e3 / BLOCK,
        "waits": waits(run),
    }


def waits(run: trainer.Trainer) -> dict[str, float]:
    """Return how often the processor waits for the GPU in a step, by line of this package."""
    found: Counter[str] = Counter()

    def note(message, category, filename, lineno, file=None, line=None):
        frames = [f for f in traceback.extract_stack() if "r5dgs_core" in f.filename or "gsplat" in f.filename]
        found[f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else str(message)] += 1

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = note
        torch.cuda.set_sync_debug_mode("warn")
        try:
            for _ in range(BLOCK):
                run.step()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return {place: count / BLOCK for place, count in found.items()}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int, default=12000)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.device == "cpu":
        warm_up.warm_up()
    dataset = datasets.read(args.data)
    rows = []
    print(f"{'':32} {'Gaussians':>9} {'median ms':>9} {'least ms':>9}")
    for name in args.variants:
        row = {"variant": name, **measure(dataset, VARIANTS[name], args.gaussians, args.steps, args.device)}
        rows.append(row)
        print(f"{name:32} {row['gaussians']:>9} {row['median_ms']:>9.2f} {row['least_ms']:>9.2f}", flush=True)
        if "kernels" in row:
            print(f"    {row['kernels']:.0f} kernels in {row['kernel_ms']:.2f} ms; waits: {row['waits'] or 'none'}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()

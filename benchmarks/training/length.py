"""Peak memory and time of training against the number of frames. Linux only.

    python -m benchmarks.training length [--times 15 30 60] [--cameras 20] [--size 1440] [--steps 20]
                                         [--set SECTION.KEY=VALUE] [--json FILE]

For each number of times, a capture of moving balls (`memory.make_dataset`) is trained for some steps in a process of
its own. Only ``--drawn`` times are ray cast; the files of the other times are links to these, so that a long capture
is made quickly, but is read like any other. ``images`` is the size of all images and masks as 8-bit pixels. ``peak`` is
the peak resident memory, ``start`` the processor seconds until the first step, ``step`` those of a step (the median).
Images of 1440 x 1440 have as many pixels as those of 1920 x 1080. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from .. import timing
from . import memory


def extend(drawn: Path, folder: Path, cameras: int, times: int) -> None:
    """Write a data set of more times, whose images are links to those of another one (`memory.make_dataset`)."""
    header = json.loads((drawn / "transforms_train.json").read_text())
    given, frames = header["frames"], []
    steps = len(given) // cameras
    for step in range(times):
        # Forth and back through the drawn times, so that the motion is continuous.
        there = step % max(1, 2 * steps - 2)
        source = there if there < steps else 2 * steps - 2 - there
        for camera in range(cameras):
            frame = given[source * cameras + camera]
            name = f"train/c{camera:02d}_{step:05d}"
            for inner in ("", "object_mask/"):
                target = folder / f"{inner}{name}.png"
                target.parent.mkdir(parents=True, exist_ok=True)
                os.link(drawn / f"{inner}{frame['file_path']}.png", target)
            t = memory.T_MAX * step / max(1, times - 1)
            frames.append({**frame, "file_path": name, "time": t})
    (folder / "transforms_train.json").write_text(json.dumps({**header, "frames": frames}))


def measure(data: Path, steps: int, overrides: list[str], answers: Any) -> None:
    """Train for some steps, and put the measured figures into a queue."""
    from r5dgs_core.config import config
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.data import memory as pixels
    from r5dgs_core.train import trainer, warm_up

    warm_up.warm_up()
    settings = config.load(None, ["train.iterations=100000", "curriculum.first=0", "curriculum.grow=0", *overrides])
    dataset = datasets.read(data)
    base, began = timing.status_mb("VmHWM"), time.process_time()
    run = trainer.Trainer(dataset, settings)
    start, times = time.process_time() - began, []
    at_start = timing.status_mb("VmHWM")
    for _ in range(steps):
        began = time.process_time()
        run.step()
        times.append(time.process_time() - began)
    answers.put(
        {
            "views": len(dataset.train),
            "gaussians": len(run.gaussians),
            "images_mb": round(pixels.of_images(dataset) / 2**20),
            "base_mb": round(base),
            "start_mb": round(at_start),
            "peak_mb": round(timing.status_mb("VmHWM")),
            "start_s": round(start, 1),
            "step_ms": round(1e3 * statistics.median(times), 1),
        }
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, nargs="+", default=[15, 30, 60])
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--size", type=int, default=1440, help="width and height of the images, pixels")
    parser.add_argument("--drawn", type=int, default=3, help="times that are ray cast")
    parser.add_argument("--objects", type=int, default=4)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--folder", type=Path, help="folder of the data sets; they are kept, and used if they exist")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    spawn, rows = multiprocessing.get_context("spawn"), []
    columns = ("times", "views", "gaussians", "images_mb", "start_mb", "peak_mb", "start_s", "step_ms")
    print("".join(f"{name:>11}" for name in columns))
    with tempfile.TemporaryDirectory() as name:
        root = args.folder or Path(name)
        drawn = root / "drawn"
        if not drawn.exists():
            memory.make_dataset(drawn, args.size, args.cameras, args.drawn, args.objects)
        for times in args.times:
            data = root / f"times_{times}"
            if not data.exists():
                extend(drawn, data, args.cameras, times)
            answers = spawn.Queue()
            child = spawn.Process(target=measure, args=(data, args.steps, args.set, answers))
            child.start()
            child.join()
            if child.exitcode:
                raise SystemExit(f"{times} times: the training failed with exit code {child.exitcode}")
            rows.append({"times": times, **answers.get()})
            print("".join(f"{rows[-1][name]:>11}" for name in columns), flush=True)
    if args.json:
        args.json.write_text(json.dumps({"size": args.size, "cameras": args.cameras, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()

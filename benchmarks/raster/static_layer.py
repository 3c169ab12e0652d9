"""Time of drawing moving Gaussians into a static layer, against drawing everything.

    python -m benchmarks.raster static_layer [--json FILE]

In a workload of `workloads`, the Gaussians nearest to one point move together. ``covered`` is the share of tiles that
they touch, ``ratio`` compares minimum processor times, and ``build_ms`` is the time to build the layer. Both images
must be equal bit for bit. Results: docs/results/rasterizer.md.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.raster import rasterize_splats, thread_pool
from r5dgs_core.raster.cpu.projection import TILE
from r5dgs_core.raster.cpu.static_layer import StaticLayer

from ..timing import Contender, take_turns
from . import workloads

COLUMNS = ("workload", "threads", "moving", "covered", "build_ms", "all_ms", "backdrop_ms", "ratio")


def measure(name: str, share: float, threads: int, repeats: int) -> dict:
    """Measure one row."""
    work = workloads.make(name)
    inputs, camera = work.inputs, work.camera
    distances = (inputs[0] - torch.tensor([0.2, 0.1, -0.3])).norm(dim=1)
    order = torch.argsort(distances)
    count = round(share * len(order))
    moving, still = ([t[rows].contiguous() for t in inputs] for rows in (order[:count], order[count:]))
    thread_pool.set_threads(threads)
    start = time.perf_counter()
    backdrop = StaticLayer(*still, camera)
    build_ms = 1e3 * (time.perf_counter() - start)
    everything = [torch.cat(parts) for parts in zip(still, moving, strict=True)]
    together, apart = rasterize_splats(*everything, camera), backdrop.draw(*moving)
    if not torch.equal(together.image, apart.image):
        raise AssertionError(f"{name}: the backdrop's image differs")
    alone = rasterize_splats(*moving, camera).alpha.numpy()
    corners = [(y, x) for y in range(0, camera.height, TILE) for x in range(0, camera.width, TILE)]
    tiles = [alone[y : y + TILE, x : x + TILE].any() for y, x in corners]
    contenders = [
        Contender({"way": "all"}, lambda: rasterize_splats(*everything, camera)),
        Contender({"way": "backdrop"}, lambda: backdrop.draw(*moving)),
    ]
    take_turns(contenders, repeats)
    all_ms, backdrop_ms = (contender.times.cpu[0] for contender in contenders)
    found = (name, threads, share, float(np.mean(tiles)), build_ms, all_ms, backdrop_ms, all_ms / backdrop_ms)
    return {k: round(v, 3) if isinstance(v, float) else v for k, v in zip(COLUMNS, found, strict=True)}


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workloads", default="W1,W3", help="names in workloads.py")
    parser.add_argument("--moving", default="0.01,0.05,0.2,0.5", help="shares of the Gaussians that move")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    for name in options.workloads.split(","):
        try:
            workloads.check(name)
        except ValueError as error:
            parser.error(str(error))
    rows = []
    print(" ".join(f"{column:>12}" for column in COLUMNS))
    with torch.no_grad():
        for name in options.workloads.split(","):
            for threads in map(int, options.threads.split(",")):
                for share in map(float, options.moving.split(",")):
                    rows.append(measure(name, share, threads, options.repeats))
                    print(" ".join(f"{rows[-1][column]!s:>12}" for column in COLUMNS), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

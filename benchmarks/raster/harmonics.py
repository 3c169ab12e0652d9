"""Time of colors from spherical harmonics: kernels against plain torch or numpy.

    python -m benchmarks.raster harmonics [--json FILE]

Rows are the view-dependent colors of N Gaussians, forward and with gradients of coefficients and centres, and a sky;
columns as in `speed`. Interleaved rounds on one thread; ``ratio`` compares minimum processor times.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.raster import shade, thread_pool
from r5dgs_core.scene import cameras, spherical_harmonics
from r5dgs_core.scene.cameras import Camera

from ..timing import Contender, take_turns

COLUMNS = ("work", "degree", "way", "cpu_ms", "wall_ms_min", "wall_ms_median", "peak_mb", "ratio")


def colors(count: int, degree: int, fused: bool) -> dict[str, Callable]:
    """The colours of random Gaussians: forward, and forward and backward."""
    draws = torch.Generator().manual_seed(degree)
    means = torch.randn(count, 3, generator=draws)
    sh = 0.5 * torch.randn(count, (degree + 1) ** 2, 3, generator=draws)
    upstream = torch.randn(count, 3, generator=draws)
    eye = np.array([0.5, -4.0, 1.0])

    def forward_backward():
        leaves = means.detach().requires_grad_(), sh.detach().requires_grad_()
        shade.seen_colors(*leaves, eye, backend="auto" if fused else "reference").backward(upstream)

    return {
        "forward": lambda: shade.seen_colors(means, sh, eye, backend="auto" if fused else "reference"),
        "forward_backward": forward_backward,
    }


def sky(size: int, degree: int, fused: bool) -> dict[str, Callable]:
    """A sky of random colours."""
    camera = Camera(size, size, np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]), np.eye(4))
    sh = np.random.default_rng(degree).normal(size=((degree + 1) ** 2, 3))
    if fused:
        return {"sky": lambda: shade.sky(sh, camera)}
    return {"sky": lambda: np.clip(spherical_harmonics.to_rgb(sh, cameras.pixel_rays(camera)), 0, 1).astype(np.float32)}


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=40_000, help="Gaussians")
    parser.add_argument("--size", type=int, default=400, help="width and height of the sky in px")
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    thread_pool.set_threads(1)
    rows = []
    print(" ".join(f"{column:>16}" for column in COLUMNS))
    for degree in (1, 2, 3):
        ways = {
            way: {**colors(options.count, degree, fused), **sky(options.size, degree, fused)}
            for way, fused in (("kernel", True), ("plain", False))
        }
        for work in ways["kernel"]:
            contenders = [Contender({"work": work, "degree": degree, "way": way}, ways[way][work]) for way in ways]
            take_turns(contenders, options.turns)
            found = [contender.row() for contender in contenders]
            for row in found:
                rows.append({**row, "ratio": round(row["cpu_ms"] / found[0]["cpu_ms"], 1)})
                print(" ".join(f"{rows[-1][column]!s:>16}" for column in COLUMNS), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Times colours out of spherical harmonics, kernels against plain torch or numpy: `python benchmarks/harmonics.py`.

Rows are the colours of N Gaussians as an eye sees them, forward and with gradients of coefficients and centres, and a
sky. All run on one thread and in turns, so that a busy machine slows both alike; ``ratio`` is of the medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.model import spherical_harmonics
from r5dgs_core.raster import compile as compilation
from r5dgs_core.raster import harmonics
from r5dgs_core.scene import cameras
from r5dgs_core.scene.cameras import Camera

COLUMNS = ("work", "degree", "kernel_ms", "kernel_ms_min", "plain_ms", "ratio")


def colors(count: int, degree: int, fused: bool) -> tuple[Callable, Callable]:
    """Functions that evaluate the colours of random Gaussians: forward, and forward and backward."""
    draws = torch.Generator().manual_seed(degree)
    means = torch.randn(count, 3, generator=draws)
    sh = 0.5 * torch.randn(count, (degree + 1) ** 2, 3, generator=draws)
    upstream = torch.randn(count, 3, generator=draws)
    eye = np.array([0.5, -4.0, 1.0])

    def forward_backward():
        leaves = means.detach().requires_grad_(), sh.detach().requires_grad_()
        harmonics.seen_colors(*leaves, eye, fused=fused).backward(upstream)

    return lambda: harmonics.seen_colors(means, sh, eye, fused=fused), forward_backward


def skies(size: int, degree: int) -> tuple[Callable, Callable]:
    """Functions that draw a sky: by the kernel, and by numpy."""
    camera = Camera(size, size, np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]), np.eye(4))
    sh = np.random.default_rng(degree).normal(size=((degree + 1) ** 2, 3))
    return (
        lambda: harmonics.sky(sh, camera),
        lambda: np.clip(spherical_harmonics.to_rgb(sh, cameras.pixel_rays(camera)), 0, 1).astype(np.float32),
    )


def measure(kernel: Callable, plain: Callable, repeats: int) -> dict[str, float]:
    """Milliseconds of both."""
    times: tuple[list[float], list[float]] = ([], [])
    kernel(), plain()
    for _ in range(repeats):
        for function, found in zip((kernel, plain), times, strict=True):
            start = time.perf_counter()
            function()
            found.append(1e3 * (time.perf_counter() - start))
    ours, theirs = map(statistics.median, times)
    return {
        "kernel_ms": round(ours, 3),
        "kernel_ms_min": round(min(times[0]), 3),
        "plain_ms": round(theirs, 3),
        "ratio": round(theirs / ours, 1),
    }


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=40_000, help="Gaussians")
    parser.add_argument("--size", type=int, default=400, help="width and height of the sky in px")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path, help="write the rows here, too")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    compilation.set_threads(1)
    rows = []
    print(" ".join(f"{column:>16}" for column in COLUMNS))
    for degree in (1, 2, 3):
        pairs = zip(colors(options.count, degree, True), colors(options.count, degree, False), strict=True)
        for work, pair in zip(
            ("forward", "forward_backward", "sky"), [*pairs, skies(options.size, degree)], strict=True
        ):
            rows.append({"work": work, "degree": degree, **measure(*pair, options.repeats)})
            print(" ".join(f"{rows[-1][column]!s:>16}" for column in COLUMNS), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

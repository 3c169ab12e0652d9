"""Times the rasterizer on fixed workloads: `python benchmarks/raster.py [--json FILE]`.

A row is one pass over one workload with one backend and number of threads. Times are of the whole call, checks
included: ``cpu_ms`` is the smallest processor time over all threads (comparable on a busy machine), wall times are
smallest and median, and ``peak_mb`` is the largest resident memory during the pass beyond that before it (null where
the system does not tell). ``forward`` runs without gradients, ``forward_backward`` with gradients of every input. The
threads are the rasterizer's; torch's own few operations run on one, or its waiting threads would be counted too.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.raster import rasterize_splats
from r5dgs_core.scene.cameras import Camera

COLUMNS = ("workload", "backend", "threads", "pass", "cpu_ms", "wall_ms_min", "wall_ms_median", "peak_mb")


@dataclass(frozen=True)
class Workload:
    """A cube of random Gaussians before a camera.

    Attributes:
        count: Number of Gaussians.
        size: Width and height of the image, px.
        n_channels: Channels to blend.
        radius_px: Median of three standard deviations along the longest axis, px.
    """

    count: int
    size: int
    n_channels: int
    radius_px: float = 4.0


WORKLOADS = {
    "train": Workload(12_000, 128, 3),  # a training step of the demo
    "train+16": Workload(12_000, 128, 19),  # the same with identity encodings
    "W1": Workload(40_000, 400, 3),
    "W1h": Workload(40_000, 400, 3, radius_px=12.0),
    "W2": Workload(40_000, 400, 19),
    "W3": Workload(200_000, 800, 3),
}


def make(workload: Workload, seed: int = 0) -> tuple[list[torch.Tensor], Camera]:
    """Inputs of `rasterize_splats` and the camera: centres uniform in a cube, log-normal sizes and anisotropy."""
    random = np.random.default_rng(seed)
    n, size = workload.count, workload.size
    focal = 0.5 * size / np.tan(np.radians(25.0))
    eye = np.array([0.5, -0.4, -3.0])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T_cam_world[:3, 3] = -T_cam_world[:3, :3] @ eye
    camera = Camera(
        size, size, np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]), T_cam_world, "benchmark"
    )
    means = random.uniform(-1, 1, (n, 3))
    quats = random.normal(size=(n, 4))
    scales = np.exp(0.5 * random.normal(size=(n, 1)) + 0.5 * random.normal(size=(n, 3)))
    depths = means @ T_cam_world[2, :3] + T_cam_world[2, 3]
    scales *= workload.radius_px / 3 / np.median(scales.max(1) * focal / depths)
    arrays = (
        means,
        quats,
        scales,
        random.uniform(0.1, 0.99, n),
        random.uniform(0, 1, (n, workload.n_channels)),
    )
    return [torch.tensor(array, dtype=torch.float32) for array in arrays], camera


def measure(run, repeats: int) -> dict:
    """Times and memory of ``run()``, after one call that compiles and warms up."""
    run()
    cpu, wall, peaks = [], [], []
    for _ in range(repeats):
        before = _reset_peak_mb()
        cpu_start, wall_start = time.process_time(), time.perf_counter()
        run()
        cpu.append(1e3 * (time.process_time() - cpu_start))
        wall.append(1e3 * (time.perf_counter() - wall_start))
        if before is not None:
            peaks.append(_status_mb("VmHWM") - before)
    return {
        "cpu_ms": round(min(cpu), 3),
        "wall_ms_min": round(min(wall), 3),
        "wall_ms_median": round(statistics.median(wall), 3),
        "peak_mb": round(max(peaks), 1) if peaks else None,
    }


def _reset_peak_mb() -> float | None:
    """Give freed memory back and let Linux forget its largest size; returns the present one, None on other systems."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        return _status_mb("VmRSS")
    except (OSError, AttributeError, TypeError):
        return None


def _status_mb(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) / 1024
    raise OSError(f"/proc/self/status: no {key}")


def run_workload(name: str, backend: str, threads: int, repeats: int) -> list[dict]:
    """Rows for both passes."""
    inputs, camera = make(WORKLOADS[name])
    upstream = torch.randn(
        (camera.height, camera.width, inputs[-1].shape[1]), generator=torch.Generator().manual_seed(1)
    )
    torch.set_num_threads(1 if backend == "cpu" else threads)
    if backend == "cpu":
        from r5dgs_core.raster import compile as compilation

        compilation.set_threads(threads)

    @torch.no_grad()
    def forward():
        rasterize_splats(*inputs, camera, backend=backend)

    def forward_backward():
        leaves = [tensor.detach().requires_grad_() for tensor in inputs]
        rasterize_splats(*leaves, camera, backend=backend).image.backward(upstream)

    row = {"workload": name, "backend": backend, "threads": threads}
    return [
        {**row, "pass": "forward", **measure(forward, repeats)},
        {**row, "pass": "forward_backward", **measure(forward_backward, repeats)},
    ]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workloads", nargs="+", choices=WORKLOADS, default=["train", "train+16", "W1", "W1h", "W2"])
    parser.add_argument("--backends", nargs="+", default=["cpu"], help="cpu, reference")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", type=Path, help="write the rows here, too")
    options = parser.parse_args(arguments)
    rows = []
    print(" ".join(f"{column:>16}" for column in COLUMNS))
    for name in options.workloads:
        for backend in options.backends:
            for threads in options.threads:
                for row in run_workload(name, backend, threads, options.repeats):
                    rows.append(row)
                    print(" ".join(f"{row[column]!s:>16}" for column in COLUMNS), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

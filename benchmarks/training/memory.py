"""Peak memory of training by phase, with a given number of Gaussians. Linux only.

    python -m benchmarks.training memory [--gaussians 300000] [--size 400] [--cameras 12] [--times 12] [--steps 24]
                                         [--json FILE]

A data set of moving textured balls on a textured floor is ray cast in a separate process. Gaussians double in rounds
up to the given number; then some steps are taken, a checkpoint is written, labels and identities are computed, and the
scene is baked. Memory is the peak resident size of each phase; seconds are processor time. Results:
docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .. import timing

ANGLE_X = 0.7
T_MAX = 0.75


def ray_cast(camera_world: np.ndarray, t: float, width: int, objects: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours [W, W, 3] in [0, 1] and object ids [W, W] of balls that move over a floor under a sky.

    Args:
        camera_world: Camera to world, OpenGL axes. [4, 4]
        t: Time.
        width: Width and height of the image, pixels.
        objects: Number of balls.
    """
    focal = 0.5 * width / np.tan(0.5 * ANGLE_X)
    u = (np.arange(width) + 0.5 - 0.5 * width) / focal
    rays = np.stack([*np.broadcast_arrays(u[None, :], -u[:, None]), np.full((width, width), -1.0)], -1)
    rays = rays @ camera_world[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = camera_world[:3, 3]
    color = np.stack([0.5 + 0.1 * rays[..., 2], 0.6 + 0.1 * rays[..., 2], np.full((width, width), 0.85)], -1)
    nearest, ids = np.full((width, width), np.inf), np.zeros((width, width), np.int32)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -eye[2] / rays[..., 2]
        point = eye + depth[..., None] * rays
        floor = (depth > 0) & (np.abs(point[..., :2]) < 3).all(-1)
    color[floor] = texture(point[floor], 7.0, 0)
    nearest[floor] = depth[floor]
    for k in range(1, objects + 1):
        center, radius = ball(k, objects)
        center[:2] += (t - 0.5 * T_MAX) * radius / 0.3 * np.array([0.5 * np.sin(3.0 * k), 0.5 * np.cos(2.0 * k)])
        half = rays @ (center - eye)
        square = half**2 - ((center - eye) ** 2).sum() + radius**2
        depth = half - np.sqrt(np.maximum(square, 0))
        hit = (square > 0) & (depth > 0) & (depth < nearest)
        color[hit] = texture((eye + depth[hit][:, None] * rays[hit] - center) / radius, 4.0, k)
        nearest[hit], ids[hit] = depth[hit], k
    return color, ids


def ball(number: int, count: int) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of a ball: on a circle, or over the floor if there are more than ten."""
    if count <= 10:
        around = 2 * np.pi * number / count
        return np.array([1.1 * np.cos(around), 1.1 * np.sin(around), 0.35]), 0.3
    around, away = 2.399963 * number, 1.8 * np.sqrt(number / count)  # the golden angle fills the disc evenly
    radius = 1.2 / np.sqrt(count)
    return np.array([away * np.cos(around), away * np.sin(around), radius + 0.05]), radius


def texture(points: np.ndarray, frequency: float, seed: int) -> np.ndarray:
    """A smooth colour for each point, of several frequencies. [P, 3] -> [P, 3]"""
    rng = np.random.default_rng(seed)
    waves = frequency * rng.normal(size=(6, 3)) * np.array([1, 1, 2, 2, 4, 4])[:, None]
    mixed = np.sin(points @ waves.T + rng.uniform(0, 6, 6)) @ rng.normal(size=(6, 3))
    return 0.5 + 0.4 * np.tanh(0.5 * mixed)


def make_dataset(folder: Path, width: int, cameras: int, times: int, objects: int) -> None:
    """Write the data set: cameras on a circle, every camera at every time; two held-out views."""
    from r5dgs_core.data import images, masks

    plan = {"train": [(k, t) for t in np.linspace(0, T_MAX, times) for k in range(cameras)]}
    plan["val"] = [(0.5, 0.0), (2.5, T_MAX)]
    for split, wanted in plan.items():
        frames = []
        for i, (k, t) in enumerate(wanted):
            angle = 2 * np.pi * k / cameras
            eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 2.2 + 0.3 * np.sin(3 * angle)])
            back = eye / np.linalg.norm(eye)
            right = np.cross([0, 0, 1.0], back)
            right /= np.linalg.norm(right)
            matrix = np.eye(4)
            matrix[:3] = np.stack([right, np.cross(back, right), back, eye], -1)
            color, ids = ray_cast(matrix, float(t), width, objects)
            images.write_png(folder / split / f"r_{i:04d}.png", color)
            masks.write(folder / "object_mask" / split / f"r_{i:04d}.png", ids)
            frames.append({"file_path": f"{split}/r_{i:04d}", "time": float(t), "transform_matrix": matrix.tolist()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE_X, "frames": frames}))


class Phases:
    """Peak memory and processor time between marks."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._begin()

    def _begin(self) -> None:
        self._start_mb, self._start = timing.reset_peak_mb(), time.process_time()

    def mark(self, phase: str, gaussians: int | None = None) -> None:
        """End a phase and print its row."""
        row = {
            "phase": phase,
            "gaussians": gaussians,
            "start_mb": self._start_mb and round(self._start_mb),
            "peak_mb": round(timing.status_mb("VmHWM")),
            "cpu_s": round(time.process_time() - self._start, 1),
        }
        self.rows.append(row)
        count = "" if gaussians is None else f"{gaussians}"
        print(f"{phase:<34} {count:>9} {row['peak_mb']:>8} {row['cpu_s']:>8}", flush=True)
        self._begin()


def measure(data: Path, folder: Path, gaussians: int, steps: int, overrides: list[str]) -> list[dict[str, Any]]:
    """Train and bake; returns a row for each phase."""
    print(f"{'phase':<34} {'Gaussians':>9} {'peak MB':>8} {'CPU s':>8}")
    phases = Phases()
    from r5dgs_core.bake import bake
    from r5dgs_core.config import config
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.render import warm_up
    from r5dgs_core.train import checkpoint, run

    warm_up.warm_up()
    phases.mark("imports and kernels")
    growth = 2 * int(np.ceil(np.log2(max(2.0, gaussians / 1000))))
    settings = config.load(
        None,
        [
            f"train.iterations={growth + steps}",
            f"densify.max_gaussians={gaussians}",
            *("densify.start=2", "densify.every=2", "densify.gradient=0", "densify.share=1", "densify.prune_opacity=0"),
            f"densify.stop={growth / (growth + steps)}",
            *("identity.iterations=8", "train.log_every=1", f"train.probe_every={growth + steps}"),
            *overrides,
        ],
    )
    counts = [0]

    def watch(event: dict[str, Any]) -> None:
        name = event["event"]
        if name == "prepare" and "objects" in event["text"]:
            phases.mark("data set")
        elif name == "step":
            if event["iteration"] == 1:
                phases.mark("images and placing, first step", event["gaussians"])
            elif event["iteration"] == growth:
                phases.mark("growth", event["gaussians"])
            counts[0] = event["gaussians"]
        elif name == "prepare" and "labels" in event["text"]:
            phases.mark("steps, probe and checkpoint", counts[0])
        elif name == "identity" and event["iteration"] == 1:
            phases.mark("labels, first step of identities", counts[0])
        elif name == "trained":
            phases.mark("identities and last checkpoint", counts[0])

    done = run.train(data, folder / "run", settings, progress=watch)
    scene = bake.run_bake(done.folder, folder / "scene.r5dgs")
    phases.mark("bake", len(scene.gaussians.means))
    size = (done.folder / checkpoint.CHECKPOINT_FILE).stat().st_size / 2**20
    print(f"checkpoint {size:.0f} MB, {len(datasets.read(data).train)} training images")
    return phases.rows


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="data set to train on; it is created if missing")
    parser.add_argument("--gaussians", type=int, default=300_000)
    parser.add_argument("--size", type=int, default=400, help="width and height of the images, pixels")
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--times", type=int, default=12)
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--steps", type=int, default=24, help="steps after the growth")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        data = args.data or Path(name) / "data"
        if not data.exists():
            given = (data, args.size, args.cameras, args.times, args.objects)
            maker = multiprocessing.get_context("spawn").Process(target=make_dataset, args=given)
            maker.start()
            maker.join()
        rows = measure(data, Path(name), args.gaussians, args.steps, args.set)
    print(f"largest: {max(row['peak_mb'] for row in rows)} MB")
    if args.json:
        args.json.write_text(json.dumps({"size": args.size, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()

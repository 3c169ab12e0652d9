"""Training from the points of a large COLMAP reconstruction. Linux only.

    python -m benchmarks.training reconstruction DATA SCENE [--points 200000 ...] [--noise 0.003]
                                             [--set SECTION.KEY=VALUE] [--json FILE]

DATA, which has fixed cameras, is written as a COLMAP data set: one registered image per camera, the times of all
frames, masks, and points on surfaces that the training views show, from depths of SCENE, which was trained on DATA.
Depths have normally distributed relative errors. For each number of points, a process trains and prints the Gaussians
at the start, at most and at the end, their cap, how many initial sizes differ by more than a percent from the mean
distance to the three nearest points, processor seconds until the first step and of a step (the median), the peak
memory, and the PSNR on ``val`` of DATA. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import struct
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .. import own_process, timing

PINHOLE = 1  # COLMAP's id of the lens


def surface_points(
    data: Path, scene_path: Path, count: int, noise: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points on the surfaces that the training views show, and their colours. [count, 3] each"""
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.playback import scene_player
    from r5dgs_core.render import scene_renderer
    from r5dgs_core.scene import cameras, scene_file

    scene, views = scene_file.read(scene_path), datasets.read(data).train
    player = scene_player.Player(scene)
    shares = np.bincount(rng.integers(len(views), size=count), minlength=len(views))
    points, colors = [], []
    for view, share in zip(views, shares, strict=True):
        picture = scene_renderer.render(player, view.camera, view.t)
        opaque = np.argwhere(picture.alpha.reshape(picture.depth.shape) > 0.9)
        rows, columns = opaque[rng.integers(len(opaque), size=share)].T
        rays = cameras.pixel_rays(view.camera)[rows, columns]
        z = picture.depth[rows, columns] * (1 + noise * rng.normal(size=share))
        points.append(view.camera.center + rays * (z / (rays @ view.camera.forward))[:, None])
        colors.append(datasets.load_image(view)[rows, columns])
    return np.concatenate(points), np.concatenate(colors)


def write(data: Path, folder: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write a data set of fixed cameras with binary files of COLMAP."""
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.motion import rotations

    times, standing = {}, {}
    for view in datasets.read(data).train:
        name = f"{view.camera.name}/{Path(view.name).name}.png"
        standing.setdefault(view.camera.name, (name, view.camera))
        times[name] = view.t
        for source, inner in ((view.image_path, "images"), (view.mask_path, "object_mask")):
            (folder / inner / name).parent.mkdir(parents=True, exist_ok=True)
            os.symlink(source.resolve(), folder / inner / name)
    (folder / "times.json").write_text(json.dumps(times))
    count = struct.pack("<Q", len(standing))
    lenses, images = count, count
    for number, (name, camera) in enumerate(standing.values(), 1):
        k, T = camera.intrinsics, camera.T_cam_world
        lens = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        lenses += struct.pack("<iiQQ4d", number, PINHOLE, camera.width, camera.height, *lens)
        quat = rotations.rotmats_to_quats(T[None, :3, :3])[0]
        images += struct.pack("<I7dI", number, *quat, *T[:3, 3], number) + name.encode() + b"\0" + struct.pack("<Q", 0)
    kind = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("seen", "<u8")])
    table = np.zeros(len(points), kind)
    table["id"], table["place"], table["color"] = np.arange(len(points)), points, np.round(255 * colors)
    cloud = struct.pack("<Q", len(points)) + table.tobytes()
    (folder / "sparse" / "0").mkdir(parents=True)
    for name, content in {"cameras": lenses, "images": images, "points3D": cloud}.items():
        (folder / "sparse" / "0" / f"{name}.bin").write_bytes(content)


def make(data: Path, scene: Path, count: int, noise: float, folder: Path) -> None:
    """Write the data set of a number of points."""
    write(data, folder, *surface_points(data, scene, count, noise, np.random.default_rng(0)))


def measure(colmap: Path, data: Path, overrides: list[str]) -> dict[str, Any]:
    """Train, and return the measured figures."""
    from scipy.spatial import KDTree

    from r5dgs_core.config import config
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.train import trainer, view_psnr, warm_up

    warm_up.warm_up()
    timing.reset_peak_mb()
    began = time.process_time()
    dataset = datasets.read(colmap)
    run = trainer.Trainer(dataset, config.load(None, overrides))
    row: dict[str, Any] = {"points": len(dataset.points), "start_s": time.process_time() - began}
    means, sizes = (run.gaussians.params[name].detach().numpy() for name in ("means", "log_scales"))
    solid = np.ptp(sizes, axis=1) == 0  # shadows are flat
    near = KDTree(means[solid]).query(means[solid], k=4)[0][:, 1:].mean(1)
    off = np.abs(np.exp(sizes[solid, 0]) - near) > 0.01 * near
    row |= {"at_start": len(means), "cap": run._conditions.cap, "other_sizes": float(off.mean())}
    row |= {"nearest": float(np.median(near)), "size": float(np.median(np.exp(sizes[solid, 0])))}
    most, seconds = len(means), []
    while not run.done:
        began = time.process_time()
        run.step()
        seconds.append(time.process_time() - began)
        most = max(most, len(run.gaussians))
    row |= {"at_most": most, "at_end": len(run.gaussians), "step_s": statistics.median(seconds)}
    row |= {"steps_s": sum(seconds), "mb": timing.status_mb("VmHWM")}
    run.dataset = datasets.read(data)
    return {**row, "val_psnr": view_psnr.HeldOutPsnr(run, 100).measure()}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--points", type=int, nargs="+", default=[200_000])
    parser.add_argument("--noise", type=float, default=0.003, help="standard deviation of depths, relative")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for count in args.points:
        with tempfile.TemporaryDirectory() as name:
            colmap = Path(name, "colmap")
            own_process.run(make, args.data, args.scene, count, args.noise, colmap)
            rows.append(own_process.run(measure, colmap, args.data, args.set))
        print({key: round(value, 4) for key, value in rows[-1].items()}, flush=True)
        if args.json:
            args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

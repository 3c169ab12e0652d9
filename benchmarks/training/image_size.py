"""Quality of one scene at several image sizes. Linux only.

    python -m benchmarks.training image_size DATA [--lines 256 1080] [--evaluated val test] [--set SECTION.KEY=VALUE]
                                                  [--folder DIR] [--json FILE]

Copies of the data set with smaller images, reduced by averaging, are trained with the same settings, each in a process
of its own. A scene is measured on the images of its own size, and on those of the smallest size, for which its pictures
are reduced in the same way. ``objects`` is the PSNR of the objects' pixels. Seconds are processor time of training.
Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .. import own_process, timing


def averages(size: int, smaller: int) -> np.ndarray:
    """Weights with which each pixel of a smaller line averages those of a line. [smaller, size]"""
    edges = np.linspace(0, size, smaller + 1)
    pixels = np.arange(size)
    shared = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return np.maximum(shared, 0) * smaller / size


def reduced(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Average a picture over the pixels of a smaller one. [H, W, C] -> [height, width, C]"""
    lines = np.tensordot(averages(picture.shape[0], height), picture, 1)
    return np.swapaxes(np.tensordot(averages(picture.shape[1], width), np.swapaxes(lines, 0, 1), 1), 0, 1)


def resize(data: Path, lines: int, folder: Path) -> Path:
    """Copy a data set with images of a number of lines; returns its folder."""
    from r5dgs_core.data import images, masks

    shutil.copytree(data, folder)
    for path in sorted(folder.rglob("*.png")):
        if "object_mask" in path.parts:
            ids = masks.read(path)
            masks.write(path, masks.resize(ids, round(ids.shape[1] * lines / ids.shape[0]), lines, str(path)))
        else:
            pixels = images.read_png(path).astype(np.float64) / 255
            images.write_png(path, reduced(pixels, lines, round(pixels.shape[1] * lines / pixels.shape[0])))
    return folder


def train(data: Path, folder: Path, overrides: list[str]) -> dict[str, float]:
    """Train and bake a scene; return its cost."""
    from r5dgs_core.bake import bake
    from r5dgs_core.config import config
    from r5dgs_core.train import run, warm_up

    warm_up.warm_up()
    timing.reset_peak_mb()
    began = time.process_time()
    done = run.train(data, folder, config.load(None, overrides), progress=_report)
    row = {"seconds": time.process_time() - began, "mb": timing.status_mb("VmHWM")}
    scene = bake.run_bake(done.folder, folder / "scene.r5dgs")
    return {**row, "gaussians": len(scene.gaussians.means)}


def _report(event: dict[str, Any]) -> None:
    """Print the measurements of held-out views."""
    if event["event"] == "probe":
        print(event, flush=True)


def measure(path: Path, data: Path, smallest: Path, splits: list[str]) -> dict[str, float]:
    """Return the mean PSNR by split, of all pixels and of the objects, at the own and the smallest size."""
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.evaluation import evaluate, metrics
    from r5dgs_core.playback import scene_player
    from r5dgs_core.scene import scene_file

    scene, own, small = scene_file.read(path), datasets.read(data), datasets.read(smallest)
    move = scene_player.Player(scene).frame
    row: dict[str, float] = {}
    for split in splits:
        found: dict[str, list[float]] = {}
        for large_view, view in zip(own.views(split), small.views(split), strict=True):
            color = evaluate.render_timed(scene, large_view.camera, large_view.t, move).color
            small_color = reduced(color, view.camera.height, view.camera.width)
            pairs = {"": (large_view, color), "smallest ": (view, small_color)}
            for size, (seen, picture) in pairs.items():
                truth, mask = datasets.load_image(seen), datasets.load_mask(seen)
                found.setdefault(f"{size}psnr", []).append(metrics.psnr(picture, truth))
                found.setdefault(f"{size}objects", []).append(metrics.psnr(picture, truth, mask > 0))
        row |= {f"{split} {key}": float(np.nanmean(values)) for key, values in found.items()}
    return row


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--lines", type=int, nargs="+", default=[256, 1080])
    parser.add_argument("--trained", type=int, nargs="+", help="sizes to train; all if left out")
    parser.add_argument("--evaluated", nargs="+", default=["val", "test"], metavar="SPLIT")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--folder", type=Path, help="folder of the data sets and runs; they are kept, data sets used")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = {}
    with tempfile.TemporaryDirectory() as name:
        folder = args.folder or Path(name)
        sizes = {lines: folder / f"data_{lines}" for lines in sorted(args.lines)}
        folder.mkdir(parents=True, exist_ok=True)
        for lines, data in sizes.items():
            if not data.exists():
                resize(args.data, lines, data)
        for lines in sorted(args.trained or sizes):
            data, run = sizes[lines], Path(tempfile.mkdtemp(prefix=f"run_{lines}_", dir=folder), "run")
            rows[lines] = own_process.run(train, data, run, args.set)
            found = own_process.run(measure, run / "scene.r5dgs", data, next(iter(sizes.values())), args.evaluated)
            rows[lines] |= found
            print(lines, {key: round(value, 2) for key, value in rows[lines].items()}, flush=True)
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

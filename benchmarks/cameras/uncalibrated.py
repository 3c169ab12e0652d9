"""Loss of quality if the cameras are reconstructed from the images instead of calibrated.

    python -m benchmarks.cameras uncalibrated DATA [--size LINES] [--seed 0] [--set KEY=VALUE] [--json FILE]

The training images of fixed cameras, at least 384 lines high, are prepared as folders of frames: with the true
calibration and without any. Both data sets are trained. ``psnr_aligned`` is that of the split ``val`` of DATA, whose
cameras are moved into the reconstructed world by a similarity. ``px`` is the distance of the training cameras from the
true ones up to a similarity of the world (rms, pixels of DATA). Results: docs/results/captures.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.cli.commands import prepare
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.data.dataset import Dataset
from r5dgs_core.evaluation import evaluate
from r5dgs_core.motion import rotations
from r5dgs_core.render import warm_up
from r5dgs_core.scene import camera_correction, cameras
from r5dgs_core.scene.cameras import Camera
from tests.support import recordings

from ..training import timed_training
from . import disturbed

RATE = 10.0  # frames per second of the written recording


def write_recording(truth: Dataset, folder: Path) -> Path:
    """Write the training images and masks as folders of frames; returns the folder of the frames.

    Raises:
        SystemExit: The cameras do not show the same times.
    """
    views = {name: [v for v in truth.train if v.camera.name == name] for name in disturbed.training_cameras(truth)}
    times = {tuple(v.t for v in sorted(some, key=lambda v: v.t)) for some in views.values()}
    if len(times) != 1:
        raise SystemExit("the training cameras of DATA show different times; record all of them at the same times")
    for name, some in views.items():
        for number, view in enumerate(sorted(some, key=lambda v: v.t)):
            file = f"{name}/{number:06d}.png"
            images.write_png(folder / "frames" / file, datasets.load_rgba(view)[..., :3])
            images.write_png(folder / "masks" / file, datasets.load_mask(view).astype("u2"))
    names = {key: name for key, name in truth.object_names.items() if key > 0}
    (folder / "masks" / "objects.json").write_text(json.dumps(names))
    return folder / "frames"


def write_calibration(truth: Dataset, path: Path) -> Path:
    """Write the true calibration."""
    named = disturbed.training_cameras(truth)
    numbers = [[float(c.intrinsics[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))] for c in named.values()]
    lenses = tuple(Lens("pinhole", *each) for each in numbers)
    return recordings.write_calibration(path, recordings.Rig(tuple(named), tuple(named.values()), lenses))


@dataclasses.dataclass(frozen=True)
class Similarity:
    """Map of the true world to that of a data set, x -> scale turn x + shift."""

    turn: np.ndarray
    scale: float
    shift: np.ndarray

    @classmethod
    def of(cls, true: list[Camera], found: list[Camera]) -> Similarity:
        """Return the map of cameras to the same cameras in another world."""
        product = sum(f.T_cam_world[:3, :3].T @ t.T_cam_world[:3, :3] for t, f in zip(true, found, strict=True))
        turn = rotations.nearest_rotmats(np.asarray(product))
        a, b = np.stack([c.center for c in true]) @ turn.T, np.stack([c.center for c in found])
        arms = a - a.mean(0)
        scale = float((arms * (b - b.mean(0))).sum() / (arms**2).sum())
        return cls(turn, scale, b.mean(0) - scale * a.mean(0))

    def camera(self, camera: Camera) -> Camera:
        """Return a camera in the other world."""
        T = np.eye(4)
        T[:3, :3] = camera.T_cam_world[:3, :3] @ self.turn.T
        T[:3, 3] = -T[:3, :3] @ (self.scale * self.turn @ camera.center + self.shift)
        return dataclasses.replace(camera, T_cam_world=T)


def write_held_out(truth: Dataset, world: Similarity, seconds_per_unit: float, data: Path) -> None:
    """Add the split ``val`` of a data set to one that was prepared from its training images."""
    content = json.loads((data / "transforms_train.json").read_text())
    observed = np.unique([view.t for view in truth.train])
    content["data"] = {}
    for number, view in enumerate(truth.val):
        camera, name = world.camera(view.camera), f"val/{number:04d}.png"
        images.write_png(data / name, datasets.load_rgba(view)[..., :3])
        images.write_png(data / "object_mask" / name, datasets.load_mask(view).astype("u2"))
        k = camera.intrinsics
        lens = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": camera.width, "h": camera.height}
        frame = float(np.interp(view.t, observed, np.arange(len(observed))))
        pose = cameras.cam_world_to_opengl(camera.T_cam_world).tolist()
        frames = [{"file_path": name, "time": frame / RATE / seconds_per_unit}]
        content["data"][f"novel{number}"] = {**lens, "transform_matrix": pose, "frames": frames}
    (data / "transforms_val.json").write_text(json.dumps(content))


def measure(truth: Dataset, frames: Path, calibration: Path | None, size: int | None, settings: config.Config) -> dict:
    """Prepare a recording with or without a calibration, train it, and measure the scene and its cameras."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        plan = prepare.run_prepare(
            frames,
            data,
            masks=str(frames.with_name("masks")),
            hold_out={"horizon": 0.0},
            calibration=calibration,
            rate=RATE,
            lines=size,
            sync="none",
        )
        given, true = disturbed.training_cameras(datasets.read(data)), disturbed.training_cameras(truth)
        world = Similarity.of([true[name] for name in given], list(given.values()))
        write_held_out(truth, world, plan.timeline.seconds_per_unit, data)
        dataset = datasets.read(data)
        scene, seconds = timed_training.train(data, settings)
        found = evaluate.evaluate(scene, dataset, splits=("val",), align=True)["splits"]["val"]["rigid"]
    record = scene.provenance.get("cameras", {})
    corrections = {n: camera_correction.from_dict(c) for n, c in record.get("corrections", {}).items()}
    now = {name: corrections[name].camera(camera) if corrections else camera for name, camera in given.items()}
    return {
        "psnr": found["psnr"],
        "psnr_aligned": found["psnr_aligned"],
        "px_given": _distance(given, true, world),
        "px": _distance(now, true, world),
        "refined": record.get("refined", []),
        "gaussians": len(scene.gaussians.means),
        "cpu_seconds": seconds,
    }


def _distance(found: dict[str, Camera], true: dict[str, Camera], world: Similarity) -> float:
    """Return the distance of cameras from the true ones, with the lenses of the former, px of the latter."""
    back = Similarity(world.turn.T, 1 / world.scale, -world.turn.T @ world.shift / world.scale)
    same = {}
    for name, camera in found.items():
        zoom = true[name].height / camera.height
        lens = camera.intrinsics * [[zoom], [zoom], [1.0]]
        size = {"width": true[name].width, "height": true[name].height}
        same[name] = dataclasses.replace(back.camera(camera), intrinsics=lens, **size)
    return disturbed.distance(same, {name: true[name] for name in found})[1]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--size", type=int, help="lines of the training images (default: that of prepare)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    truth, rows = datasets.read(args.data), []
    settings = config.load(None, [f"train.seed={args.seed}", *args.set])
    print(f"{'':>13} {'psnr':>6} {'aligned':>7} {'px':>6} {'left':>6} {'cpu':>5}")
    with tempfile.TemporaryDirectory() as folder:
        frames = write_recording(truth, Path(folder))
        true = write_calibration(truth, Path(folder) / "calibration.toml")
        for how, calibration in (("calibrated", true), ("reconstructed", None)):
            row: dict[str, Any] = {"how": how, **measure(truth, frames, calibration, args.size, settings)}
            rows.append(row)
            cells = f"{row['psnr']:>6.2f} {row['psnr_aligned']:>7.2f} {row['px_given']:>6.3f} {row['px']:>6.3f}"
            print(f"{how:>13} {cells} {row['cpu_seconds']:>5.0f} {row['refined']}", flush=True)
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Frames per second on a device: networks in the loop, and baked scenes, for numbers of Gaussians and picture sizes.

    python -m benchmarks.playback RUN [--device cuda] [--gaussians N ...] [--sizes 128 1080] [--json FILE]

``RUN`` is a run of the field. More Gaussians than it has are copies with smaller sizes and opacities, which cover the
same pixels. Frames are those of the test views, 16:9 for more than 1000 lines. A frame ends when its picture is
complete in the memory of the device.

- 5DGS, networks in the loop: field and TRD are evaluated for every moving Gaussian.
- R5DGS, networks in the loop: they are evaluated for one Gaussian per group; the others move with it.
- baked, rigid, on the device: poses of the groups come from the scene; the device moves the Gaussians.
- baked, MODE, moved by the CPU: the player moves the Gaussians, and the device receives and draws them.

Results: docs/results/gpu.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r5dgs_core.bake import bake
from r5dgs_core.data import dataset as datasets
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.model.group_poses import GroupPoses
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.raster import DRAFT, rasterize_splats
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.scene.scene import Scene
from r5dgs_core.train import checkpoint, run_folder, trainer
from r5dgs_core.train.representations import field, fused_posing

MOST_FRAMES = 60
LIMIT_S = 1.5  # per row


def repeated(values: dict[str, np.ndarray], count: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return raw parameters of at least ``count`` Gaussians that cover the pixels of the given ones, and their rows."""
    own = len(values["means"])
    total, times = max(count, own), max(count / own, 1.0)
    rows = np.arange(total) * own // total
    found = {name: array[rows] for name, array in values.items()}
    if times > 1:
        spread = np.exp(found["log_scales"]) * np.random.default_rng(0).standard_normal(found["means"].shape)
        found["means"] = (found["means"] + 0.3 * spread).astype(np.float32)
        found["log_scales"] = found["log_scales"] - np.float32(0.5 * np.log(times))
    return found, rows


def scaled_scene(scene: Scene, count: int) -> Scene:
    """Return a scene with ``count`` Gaussians."""
    names = [f.name for f in dataclasses.fields(scene.gaussians) if getattr(scene.gaussians, f.name) is not None]
    values, rows = repeated({name: getattr(scene.gaussians, name) for name in names}, count)
    starts = np.searchsorted(rows, np.arange(len(scene.gaussians.means) + 1)).tolist()
    more: dict[str, Any] = {
        "gaussians": dataclasses.replace(scene.gaussians, **values),
        "residuals": None,
        "objects": tuple(
            dataclasses.replace(o, start=starts[o.start], count=starts[o.start + o.count] - starts[o.start])
            for o in scene.objects
        ),
        "groups": tuple(
            dataclasses.replace(g, anchor_index=starts[g.anchor_index] if g.anchor_index >= 0 else -1)
            for g in scene.groups
        ),
    }
    for name in ("dynamics", "shading"):
        group = getattr(scene, name)
        if group is not None:
            arrays = {f.name: getattr(group, f.name) for f in dataclasses.fields(group)}
            own = {
                k: a[rows]
                for k, a in arrays.items()
                if isinstance(a, np.ndarray) and len(a) == len(scene.gaussians.means)
            }
            more[name] = dataclasses.replace(group, **own)
    return dataclasses.replace(scene, **more)


def scaled_camera(camera: Camera, lines: int) -> Camera:
    """Return a camera with another number of lines; 16:9 for more than 1000."""
    width = round(lines * 16 / 9) if lines > 1000 else round(lines * camera.width / camera.height)
    k = camera.intrinsics * (lines / camera.height)
    k[2, 2], k[0, 2] = 1.0, k[0, 2] + 0.5 * (width - camera.width * lines / camera.height)
    return dataclasses.replace(camera, width=width, height=lines, intrinsics=k)


class OnDevice:
    """A baked scene whose Gaussians stay on a device."""

    def __init__(self, scene: Scene, device: str):
        self._device, g = device, scene.gaussians
        names = ("means", "quats", "log_scales", "opacity_logits")
        self._raw = {name: torch.from_numpy(np.asarray(getattr(g, name), np.float32)).to(device) for name in names}
        self._colors = torch.from_numpy(np.asarray(0.5 + 0.28209479 * g.sh[:, 0], np.float32)).to(device)
        self._ids = torch.from_numpy(g.motion_ids.astype(np.int64)).to(device)
        self._pivots = torch.from_numpy(np.stack([group.pivot for group in scene.groups]).astype(np.float32)).to(device)
        vectors = np.zeros_like(g.means) if scene.shading is None else scene.shading.vectors
        light = np.zeros(3) if scene.shading is None else scene.shading.light
        self._shading = torch.from_numpy(np.asarray(vectors, np.float32)).to(device)
        self._light = torch.from_numpy(np.asarray(light, np.float32)).to(device)

    def draw(self, quats: np.ndarray, displacements: np.ndarray, camera: Camera) -> torch.Tensor:
        """Draw the scene with its groups in these poses. [H, W, 3]"""
        turn, shift = (torch.from_numpy(np.asarray(a, np.float32)).to(self._device) for a in (quats, displacements))
        poses = GroupPoses(turn, rotations.quats_to_rotmats(turn), shift)
        splats = fused_posing.pose(
            **self._raw, colors=self._colors, shading=self._shading, light=self._light, motion_ids=self._ids,
            group_poses=poses, centers=self._pivots,
        )  # fmt: skip
        given = (splats.means, splats.quats, splats.scales, splats.opacities, splats.colors)
        return rasterize_splats(*given, camera, settings=DRAFT).image


def players(run: trainer.Trainer, scene: Scene, count: int, device: str) -> dict[str, Callable[[Camera, float], Any]]:
    """Return functions that draw a frame of a camera and a time, by label."""
    motion = run.motion
    assert isinstance(motion, field.FieldRepresentation)
    raw, rows = repeated({name: p.detach().cpu().numpy() for name, p in run.gaussians.params.items()}, count)
    ids = run.gaussians.motion_ids.cpu()[torch.from_numpy(rows)]
    run.gaussians = Gaussians(
        {name: torch.from_numpy(np.ascontiguousarray(a)).to(device) for name, a in raw.items()}, ids.to(device)
    )
    baked = scaled_scene(scene, count)
    resident = OnDevice(baked, device)
    first = np.array([np.flatnonzero(ids.numpy() == group.id)[:1].sum() for group in scene.groups])
    chosen = run.gaussians.means.detach()[torch.from_numpy(first).to(device)]
    rigid = scene_player.Player(baked, "rigid")

    def networks(camera: Camera, t: float) -> Any:
        return run.render(run.normalization.camera(camera), t)

    def representatives(camera: Camera, t: float) -> Any:
        moved = motion.motion.at(chosen, t)
        return resident.draw(moved.quats.cpu().numpy(), moved.offsets.cpu().numpy(), camera)

    def on_gpu(camera: Camera, t: float) -> Any:
        return resident.draw(*rigid.group_poses(t), camera)

    def by_cpu(mode: str) -> Callable[[Camera, float], Any]:
        player = scene_player.Player(baked, mode)
        return lambda camera, t: scene_renderer.render_frame(
            baked, player.frame(t, camera.center), camera, backend=device, settings=DRAFT
        )

    made = {
        "5DGS, networks in the loop": networks,
        "R5DGS, networks in the loop": representatives,
        "baked, rigid, on the device": on_gpu,
    }
    return made | {
        f"baked, {mode}, moved by the CPU": by_cpu(mode) for mode in scene_player.modes(baked) if "/" not in mode
    }


@torch.no_grad()
def frame_ms(
    draw: Callable[[Camera, float], Any], views: Sequence[tuple[Camera, float]], device: str
) -> tuple[float, int]:
    """Return the median time of a frame, ms, and the number of frames."""
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    for camera, t in views[:2]:
        draw(camera, t)
    times, began = [], time.perf_counter()
    while len(times) < MOST_FRAMES and (time.perf_counter() - began < LIMIT_S or len(times) < 3):
        camera, t = views[len(times) % len(views)]
        wait()
        start = time.perf_counter()
        draw(camera, t)
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times), len(times)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Measure frames per second on a device.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--gaussians", type=int, nargs="+", default=[12_000, 300_000, 1_000_000])
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 1080])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    opened = run_folder.open_run(args.run)
    dataset = datasets.read(opened.data())
    scene = bake.bake(opened, dataset)
    rows = []
    device = torch.cuda.get_device_name() if args.device == "cuda" else "cpu"
    for count in args.gaussians:
        trained = trainer.Trainer(dataset, opened.config.replace(**{"train.device": args.device}))
        trained.restore(checkpoint.load(args.run))
        made = players(trained, scene, count, args.device)
        for lines in args.sizes:
            views = [(scaled_camera(view.camera, lines), view.t) for view in dataset.test]
            for label, draw in made.items():
                ms, frames = frame_ms(draw, views, args.device)
                rows.append(
                    {"gaussians": count, "lines": lines, "player": label, "ms": ms, "fps": 1e3 / ms, "frames": frames}
                )
                print(f"{count:>9} {lines:>5} {label:40} {ms:8.2f} ms {1e3 / ms:7.1f} FPS", flush=True)
                if args.json:
                    args.json.write_text(json.dumps({"device": device, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()

"""Time and memory of one large scene: writing, reading, ``r5dgs render``, the worker, and F12 in Blender. Linux only.

    python -m benchmarks.large_scene SCENE [--gaussians 1000000] [--size 1920x1080] [--frames N] [--json FILE]

The scene has copies of the given one's Gaussians that are smaller and cover the same pixels. ``tabletop`` in place of
SCENE is the generated table top of `benchmarks.raster`, with harmonics of degree 3 and no copies. Each row is measured
in a process of its own: processor seconds, the peak resident memory, and the size or the PSNR of a file's pictures
against those of the scene. ``worker`` draws instances as Blender sends them: with a camera that moves in each picture,
and with a still one, for which the renderer keeps the part of the scene that does not move. ``F12`` needs bpy; its
seconds are those of the clock, because the worker is a process of its own, whose memory is the row's. Results:
docs/results/large_scenes.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import importlib.util
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from . import own_process, timing
from .playback import scaled_scene

PRECISIONS = ("compact", "quantised")
Row = dict[str, Any]


def made(source: str, count: int, size: tuple[int, int]) -> Any:
    """The scene to measure, with one camera of the size of the pictures."""
    from r5dgs_core.scene import scene_file

    from .raster import tabletop, workloads

    if source == "tabletop":
        scene = tabletop.build(count, workloads.make("tabletop").camera)
    else:
        scene = scaled_scene(scene_file.read(source), count)
    camera = scene.cameras[0]
    factor = size[1] / camera.height
    k = camera.intrinsics * factor
    k[2, 2], k[0, 2] = 1.0, k[0, 2] + 0.5 * (size[0] - camera.width * factor)
    return dataclasses.replace(
        scene, cameras=(dataclasses.replace(camera, width=size[0], height=size[1], intrinsics=k),)
    )


def least(draw: Callable[[int], object], count: int) -> Row:
    """Processor seconds of the first call, and the least of the others; the peak memory of all."""
    seconds = []
    for number in range(count + 1):
        start = time.process_time()
        draw(number)
        seconds.append(time.process_time() - start)
    return {"first_s": seconds[0], "s": min(seconds[1:]), "mb": timing.status_mb("VmHWM")}


def write(path: Path, target: Path, precision: str) -> Row:
    """Return the cost of writing a scene."""
    from r5dgs_core.scene import scene_file

    scene = scene_file.read(path)
    timing.reset_peak_mb()
    start = time.process_time()
    scene_file.write(scene, target, precision=precision)
    seconds = time.process_time() - start
    return {"s": seconds, "mb": timing.status_mb("VmHWM"), "file_mb": target.stat().st_size / 1e6}


def read(path: Path) -> Row:
    """Return the cost of reading a scene."""
    from r5dgs_core.scene import scene_file

    timing.reset_peak_mb()
    start = time.process_time()
    scene_file.read(path)
    return {"s": time.process_time() - start, "mb": timing.status_mb("VmHWM")}


def compare(path: Path, other: Path) -> Row:
    """Return the PSNR of the pictures of a file against those of another."""
    from r5dgs_core.playback import scene_player
    from r5dgs_core.render import scene_renderer
    from r5dgs_core.scene import scene_file

    pictures = []
    for one in (path, other):
        player = scene_player.Player(scene_file.read(one))
        times = (player.scene.tracks.times[0], player.scene.t_max, 1.2 * player.scene.t_max)
        camera = player.scene.cameras[0]
        pictures.append([np.clip(scene_renderer.render(player, camera, float(t)).color, 0, 1) for t in times])
    errors = [np.mean((a - b) ** 2, dtype=np.float64) for a, b in zip(*pictures, strict=True)]
    return {"psnr": float(-10 * np.log10(np.mean(errors)))}


def film(path: Path, frames: int) -> Row:
    """Return the cost of a picture of ``r5dgs render`` along an orbit."""
    from r5dgs_core.film import frame_renderer, schedule
    from r5dgs_core.film.settings import Settings
    from r5dgs_core.scene import scene_file

    scene = scene_file.read(path)
    camera = scene.cameras[0]
    size = (camera.width, camera.height)
    settings = Settings(path.with_suffix(".mp4"), ("orbit",), size=size, fps=24.0, seconds=(frames + 1) / 24)
    shots = schedule.make(scene, settings).shots
    renderer = frame_renderer.FrameRenderer(scene, samples=1)
    return least(lambda k: renderer.picture(shots[k].camera, shots[k].t), frames)


def worker(path: Path, frames: int, still: bool) -> Row:
    """Return the cost of a picture of the worker."""
    from r5dgs_core.motion import rotations
    from r5dgs_core.playback import scene_player
    from r5dgs_core.scene import scene_file
    from r5dgs_core.scene.row_runs import runs
    from r5dgs_core.worker import server

    player = scene_player.Player(scene_file.read(path))
    scene = player.scene
    rows, camera = runs(scene.gaussians.motion_ids), scene.cameras[0]
    own = server.Server()
    own.answer({"command": "load", "paths": [str(path)]})

    def draw(number: int) -> None:
        quats, displacements = player.group_poses(1.2 * scene.t_max * number / frames)
        instances = []
        for start, stop, group in rows:
            matrix, pivot = np.eye(4), scene.groups[group].pivot
            matrix[:3, :3] = rotations.quats_to_rotmats(quats[group])
            matrix[:3, 3] = pivot + displacements[group] - matrix[:3, :3] @ pivot
            instances.append({"start": start, "count": stop - start, "matrix": matrix.tolist()})
        pose = camera.T_cam_world.copy()
        pose[0, 3] += 0.0 if still else 0.01 * number
        view = {"width": camera.width, "height": camera.height, "intrinsics": camera.intrinsics.tolist()}
        own.answer({"command": "render", "camera": view | {"T_cam_world": pose.tolist()}, "instances": instances})

    return least(draw, frames)


def f12(path: Path, frames: int) -> Row:
    """Return the cost of a final render in Blender."""
    # A parent that has imported bpy passes on the folder of Blender's modules, whose bpy cannot be imported first.
    sys.path[:] = [folder for folder in sys.path if Path(folder).parts[-2:] != ("scripts", "modules")]
    import bpy

    from tests.blender import check_playback, run

    os.environ["R5DGS_PYTHON"] = sys.executable
    package = check_playback.extension_package()
    collection, *_ = run.load(path)
    modules = {
        name: importlib.import_module(f"{package}.r5dgs_core.{room}.{name}")
        for room, name in (("scene", "cameras"), ("playback", "scene_player"), ("scene", "scene_file"))
    }
    scene = modules["scene_file"].read(path)
    check_playback.add_camera(collection, scene, modules)
    view = bpy.context.scene
    view.render.engine = "R5DGS"
    view.render.resolution_x, view.render.resolution_y = scene.cameras[0].width, scene.cameras[0].height
    seconds = []
    for number in range(frames + 1):
        view.frame_set(number + 1)
        start = time.perf_counter()
        bpy.ops.render.render()
        seconds.append(time.perf_counter() - start)
    jobs = importlib.import_module(f"{package}.r5dgs_addon.worker.jobs")
    status = Path(f"/proc/{jobs._worker.pid}/status").read_text()
    mb = int(status.split("VmHWM:")[1].split()[0]) / 1e3
    return {"first_s": seconds[0], "s": min(seconds[1:]), "mb": mb, "blender_mb": timing.status_mb("VmHWM")}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="scene file, or tabletop")
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    width, height = (int(part) for part in args.size.split("x"))
    rows: dict[str, Row] = {}

    def add(name: str, work: Callable[..., Row], *arguments: object) -> None:
        rows[name] = own_process.run(work, *arguments)
        print(f"{name:20}", {key: round(value, 3) for key, value in rows[name].items()}, flush=True)
        if args.json:
            args.json.write_text(json.dumps(rows, indent=1) + "\n")

    with tempfile.TemporaryDirectory() as name:
        exact = Path(name, "exact.r5dgs")
        own_process.run(make_file, args.scene, args.gaussians, (width, height), exact)
        for precision in PRECISIONS:
            add(f"write, {precision}", write, exact, Path(name, f"{precision}.r5dgs"), precision)
            add(f"read, {precision}", read, Path(name, f"{precision}.r5dgs"))
        compact, quantised = (Path(name, f"{precision}.r5dgs") for precision in PRECISIONS)
        exact.unlink()
        add("quantised pictures", compare, quantised, compact)
        add("render", film, compact, args.frames)
        add("worker", worker, compact, args.frames, False)
        add("worker, still camera", worker, compact, args.frames, True)
        if importlib.util.find_spec("bpy") is not None:
            add("F12", f12, compact, args.frames)


def make_file(source: str, count: int, size: tuple[int, int], path: Path) -> None:
    """Write the scene to measure, in full precision."""
    from r5dgs_core.scene import scene_file

    scene_file.write(made(source, count, size), path, precision="exact")


if __name__ == "__main__":
    main()

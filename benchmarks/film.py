"""Frames per second of ``r5dgs render`` at 1080p, and its parts: drawing, encoding.

    python -m benchmarks.film SCENE ... [--gaussians N ...] [--size 1920x1080] [--frames N] [--json FILE]

The film is an orbit around the whole time of the scene. ``--gaussians`` adds scenes of that many Gaussians, copies of
the first scene's that are smaller and cover the same pixels. ``draw`` is the least processor time of a frame with one
sample, ``draw 2 x 2`` that with four, ``layers`` that of depth, index and Cryptomatte. ``mp4``, ``mov`` and ``webm``
are frames per second of processor time, and per second of wall time, of whole films without the start of the process.
Results: docs/results/film.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.playback import scaled_scene
from r5dgs_core.cli.commands.render import picture_size
from r5dgs_core.film import film, frame_renderer, schedule
from r5dgs_core.film.settings import Settings
from r5dgs_core.raster import thread_pool
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.scene import Scene

VIDEOS = (".mp4", ".mov", ".webm")


def measure(scene: Scene, size: tuple[int, int], frames: int) -> dict[str, float]:
    """Return milliseconds of the parts of a frame, and frames per second of videos."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(Path(folder, "a.mp4"), ("orbit",), size=size, fps=24.0, seconds=frames / 24)
        shots = schedule.make(scene, settings).shots
        found: dict[str, float] = {"gaussians": len(scene.gaussians.means)}
        once, fine = (frame_renderer.FrameRenderer(scene, samples=samples) for samples in (1, 2))
        found["draw_ms"] = _least(lambda k: once.picture(shots[k].camera, shots[k].t), frames)
        found["draw_2x2_ms"] = _least(lambda k: fine.picture(shots[k].camera, shots[k].t), max(frames // 4, 1))
        found["layers_ms"] = _least(lambda k: once.layers(shots[k].camera, shots[k].t), max(frames // 4, 1))
        for suffix in VIDEOS:
            out = Path(folder, f"a{suffix}")
            start, cpu = time.perf_counter(), time.process_time()
            film.write(scene, Settings(out, ("orbit",), size=size, fps=24.0, seconds=frames / 24))
            found[f"{suffix[1:]}_fps_cpu"] = frames / (time.process_time() - cpu)
            found[f"{suffix[1:]}_fps_wall"] = frames / (time.perf_counter() - start)
            found[f"{suffix[1:]}_mb"] = out.stat().st_size / 1e6
    return found


def _least(draw: Callable[[int], object], count: int) -> float:
    """Return the least processor time of a call, after one that compiles and fills caches; milliseconds."""
    draw(0)
    times = []
    for k in range(count):
        start = time.process_time()
        draw(k)
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def main() -> None:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    p.add_argument("--gaussians", type=int, nargs="*", default=[], metavar="N")
    p.add_argument("--size", type=picture_size, default=(1920, 1080), metavar="WxH")
    p.add_argument("--frames", type=int, default=48, metavar="N")
    p.add_argument("--json", type=Path, metavar="FILE")
    args = p.parse_args()
    first = scene_file.read(args.scenes[0])
    scenes = {path.stem: scene_file.read(path) for path in args.scenes}
    scenes |= {f"{args.scenes[0].stem} x {count}": scaled_scene(first, count) for count in args.gaussians}
    rows = []
    for name, scene in scenes.items():
        rows.append({"scene": name, "threads": thread_pool.threads(), **measure(scene, args.size, args.frames)})
        print(
            "  ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else str(value) for key, value in rows[-1].items()
            )
        )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()

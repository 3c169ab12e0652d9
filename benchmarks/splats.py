"""Time of splats in Blender's window: load, orbit, play and render scenes of several sizes.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" \\
        blender --factory-startup --window-geometry 0 0 1280 800 --python benchmarks/splats.py -- [GAUSSIANS ...]

Loads a synthetic scene of twelve moving bodies per size, by default 12,000, 40,000, 300,000 and 1,000,000 Gaussians.
``load`` is the time of the operator in seconds. ``orbit`` and ``play`` are the processor milliseconds of the main
thread per view and per frame for sorting and uploading, which do not depend on the graphics card; medians of twelve.
``f12`` is the time of the second render at 512 x 512 in seconds, when the worker holds the scene; `R5DGS_PYTHON` sets
the worker's Python. ``mb`` is the largest memory of Blender so far. Results: docs/results/blender.md.
"""

import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path

import bpy
from mathutils import Euler

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blender")]

import window as w  # noqa: E402  (the line before finds it)

SIZES = (12_000, 40_000, 300_000, 1_000_000)
COLUMNS = ("gaussians", "load", "orbit", "play", "f12", "mb")
VIEWS = 12


class Stopwatch:
    """Adds up the processor time that the main thread spends in functions."""

    def __init__(self):
        self.seconds = 0.0

    def wrap(self, owner, name: str) -> None:
        """Replace a function by one that is measured."""
        function = getattr(owner, name)

        def measured(*arguments, **named):
            started = time.thread_time()
            try:
                return function(*arguments, **named)
            finally:
                self.seconds += time.thread_time() - started

        setattr(owner, name, measured)

    def milliseconds(self, action) -> float:
        """Milliseconds of the measured functions during an action."""
        self.seconds = 0.0
        action()
        return 1e3 * self.seconds


def redraw() -> None:
    """Draw the window once."""
    with w.inside():
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def measure(path: Path, stopwatch: Stopwatch) -> dict[str, float]:
    """Measure one scene, which is removed at the end."""
    scene, view = w.main_window().scene, w.area_of("VIEW_3D").spaces.active.region_3d
    started = time.perf_counter()
    with w.inside():
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    row = {"load": time.perf_counter() - started}
    redraw()

    def orbit(step):
        view.view_rotation = Euler((1.1, 0, 0.5 * step)).to_quaternion()
        redraw()

    row["orbit"] = statistics.median(stopwatch.milliseconds(lambda step=step: orbit(step)) for step in range(VIEWS))

    def play(step):
        scene.frame_set(scene.frame_start + 3 * step)
        redraw()

    row["play"] = statistics.median(stopwatch.milliseconds(lambda step=step: play(step)) for step in range(VIEWS))
    scene.render.engine = "R5DGS"
    scene.render.resolution_x = scene.render.resolution_y = 512
    for _ in range(2):
        started = time.perf_counter()
        bpy.ops.render.render()
        row["f12"] = time.perf_counter() - started
    row["mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    for collection in [one for one in bpy.data.collections if one.r5dgs.is_scene]:
        bpy.data.batch_remove([*collection.all_objects, *collection.children_recursive, collection])
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    return row


def checks(sizes):
    """Measure all sizes and print a table. Yields the seconds to wait after each step."""
    from tests.blender import run

    bpy.data.batch_remove([obj for obj in bpy.data.objects if obj.type != "CAMERA"])
    stopwatch = Stopwatch()
    renderer = w.service("splats.splat_renderer")
    stopwatch.wrap(renderer.SplatBuffer, "_sorted")
    stopwatch.wrap(renderer, "_poses")
    yield 1.0
    print("".join(f"{name:>12}" for name in COLUMNS), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for count in sizes:
            row = {"gaussians": count, **measure(run.synthetic(count, Path(folder)), stopwatch)}
            print(f"{count:>12}" + "".join(f"{row[name]:>12.2f}" for name in COLUMNS[1:]), flush=True)
            yield 0.5


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    w.run(checks, [int(text) for text in given] or SIZES)

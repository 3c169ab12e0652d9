"""Time of splats in Blender's window: load, orbit, play and render scenes of several sizes.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" \\
        blender --factory-startup --window-geometry 0 0 1280 800 --python benchmarks/splats.py -- \\
            [--undrawn] [--views N] [GAUSSIANS ...]

Loads a synthetic scene of twelve moving bodies per size, by default 12,000, 40,000, 300,000 and 1,000,000 Gaussians,
each in a Blender of its own. ``load`` is the time of the operator in seconds. ``orbit``, ``play`` and ``bend`` are
processor milliseconds of the main thread per drawn view: everything that the draw handler does but the commands to the
graphics card, which a software driver executes itself. They contain the search for visible clouds, reading changed
points, sorting and uploading; medians of ``--views`` (twelve by default), in a scene whose two bending bodies have a
sixth of the Gaussians for ``bend``. ``exact`` is the time of the handler that moves those points, ``depth`` that of
reading the depth buffer beside a mesh. ``first`` and ``f12`` are the times of the first and second render at 512 x 512
in seconds; `R5DGS_PYTHON` sets the worker's Python. ``mb`` and ``worker`` are the largest memory of Blender and of the
worker. ``--undrawn`` leaves out the command that draws the instances, which takes a software driver many seconds per
view of 300,000 Gaussians and is in no column. Results: docs/results/blender.md.
"""

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blender")]

import window as w  # noqa: E402  (the line before finds it)

SIZES = (12_000, 40_000, 300_000, 1_000_000)
COLUMNS = ("gaussians", "load", "orbit", "play", "bend", "exact", "depth", "first", "f12", "mb", "worker")


class Stopwatch:
    """Adds up the processor time that the main thread spends in functions, without that of others inside them."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    def wrap(self, owner, function_name: str, name: str) -> None:
        """Replace a function by one that is measured under a name."""
        function = getattr(owner, function_name)

        def measured(*arguments, **named):
            started, before = time.thread_time(), sum(self.seconds.values())
            try:
                return function(*arguments, **named)
            finally:
                inside = sum(self.seconds.values()) - before
                self.seconds[name] = self.seconds.get(name, 0.0) + time.thread_time() - started - inside

        setattr(owner, function_name, measured)

    def milliseconds(self, action) -> dict[str, float]:
        """Milliseconds by name during an action."""
        self.seconds.clear()
        action()
        return {name: 1e3 * seconds for name, seconds in self.seconds.items()}


def medians(stopwatch: Stopwatch, views: int, action) -> dict[str, float]:
    """Medians of the milliseconds of an action with the numbers of some steps."""
    found = [stopwatch.milliseconds(lambda step=step: action(step)) for step in range(views)]
    return {name: statistics.median(one.get(name, 0.0) for one in found) for name in {n for one in found for n in one}}


def redraw() -> None:
    """Draw the window once."""
    with w.inside():
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def measure(path: Path, stopwatch: Stopwatch, views: int) -> dict[str, float]:
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

    row["orbit"] = medians(stopwatch, views, orbit)["draw"]

    def play(step):
        scene.frame_set(scene.frame_start + 3 * step)
        redraw()

    row["play"] = medians(stopwatch, views, play)["draw"]
    bpy.ops.mesh.primitive_cube_add(location=(0, 0, 100))
    row["depth"] = medians(stopwatch, views, orbit)["depth"]
    bpy.data.objects.remove(bpy.context.object)
    scene.render.engine = "R5DGS"
    scene.render.resolution_x = scene.render.resolution_y = 512
    for name in ("first", "f12"):
        started = time.perf_counter()
        bpy.ops.render.render()
        row[name] = time.perf_counter() - started
    status = Path(f"/proc/{w.service('worker.jobs')._worker.pid}/status").read_text()
    row["worker"] = int(status.split("VmHWM:")[1].split()[0]) / 1e3
    row["mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    for collection in [one for one in bpy.data.collections if one.r5dgs.is_scene]:
        bpy.data.batch_remove([*collection.all_objects, *collection.children_recursive, collection])
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    return row


def measure_bending(path: Path, stopwatch: Stopwatch, views: int) -> dict[str, float]:
    """Measure playing a scene with two bodies that bend."""
    scene = w.main_window().scene
    with w.inside():
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    redraw()

    def play(step):
        scene.frame_set(scene.frame_start + step)
        redraw()

    found = medians(stopwatch, views, play)
    return {"bend": found["draw"], "exact": found["exact"]}


def bending(path: Path) -> Path:
    """A scene file whose first two bodies bend, beside another."""
    from r5dgs_core.scene import scene_file

    scene = scene_file.read(path)
    rows = np.flatnonzero(np.isin(scene.gaussians.object_ids, (1, 2))).astype(np.int32)
    shape, draw = (len(rows), len(scene.tracks.times)), np.random.default_rng(0)
    offsets = draw.normal(scale=0.01, size=(*shape, 3)).astype(np.float32)
    offsets[:, -1] = 0
    bent = scene.with_arrays(
        residual_rows=rows,
        residual_offsets=offsets,
        residual_quats=np.tile(np.float32([1, 0, 0, 0]), (*shape, 1)),
        residual_log_scales=np.zeros((*shape, 3), np.float32),
    )
    return scene_file.write(bent, path.with_name("bending.r5dgs"))


def uploading_first(draw, undrawn: bool):
    """Replace `SplatBuffer._draw` by a function that makes the texture of changed points before it draws.

    Args:
        draw: The method.
        undrawn: True to draw no Gaussian.
    """

    def drawn(buffer, picture, poses, table, view, meshes, count):
        assert table.geometry is not None
        draw(buffer, picture, poses, table, view, meshes, 0 if undrawn else count)

    return drawn


def checks(count: int, views: int, undrawn: bool):
    """Measure a size and print its row. Yields the seconds to wait after each step."""
    from tests.blender import run

    bpy.data.batch_remove([obj for obj in bpy.data.objects if obj.type != "CAMERA"])
    stopwatch = Stopwatch()
    viewport, renderer, paste = (w.service(f"splats.{name}") for name in ("viewport_splats", "splat_renderer", "paste"))
    stopwatch.wrap(viewport, "_draw_viewport", "draw")
    stopwatch.wrap(viewport, "depth", "depth")
    stopwatch.wrap(renderer.SplatBuffer, "_draw", "card")
    renderer.SplatBuffer._draw = uploading_first(renderer.SplatBuffer._draw, undrawn)
    stopwatch.wrap(paste, "paste", "card")
    exact = w.service("motion.exact_mode")
    stopwatch.wrap(exact, "_try", "exact")
    yield 1.0
    with tempfile.TemporaryDirectory() as folder:
        path = run.synthetic(count, Path(folder))
        row = {"gaussians": count, **measure(path, stopwatch, views)}
        yield 0.5
        row |= measure_bending(bending(path), stopwatch, views)
    print(f"{count:>12}" + "".join(f"{row[name]:>10.2f}" for name in COLUMNS[1:]), flush=True)


def main(arguments: list[str]) -> None:
    """Measure one size in this Blender, or several in others."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("sizes", nargs="*", type=int, default=SIZES, metavar="GAUSSIANS")
    p.add_argument("--views", type=int, default=12, help="number of views behind each median (default: 12)")
    p.add_argument("--undrawn", action="store_true", help="do not draw the instances")
    args = p.parse_args(arguments)
    if len(args.sizes) == 1:
        w.run(checks, args.sizes[0], args.views, args.undrawn)
        return
    print(f"{COLUMNS[0]:>12}" + "".join(f"{name:>10}" for name in COLUMNS[1:]), flush=True)
    options = ["--factory-startup", "--window-geometry", "0", "0", "1280", "800", "--python", __file__, "--"]
    given = ["--views", str(args.views), *(["--undrawn"] if args.undrawn else [])]
    codes = [subprocess.run([bpy.app.binary_path, *options, *given, str(size)]).returncode for size in args.sizes]
    raise SystemExit(any(codes))


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])

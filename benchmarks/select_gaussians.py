"""Processor time of selecting Gaussians in Blender by lasso, brush and criteria, and of deleting them.

    python benchmarks/select_gaussians.py [--gaussians N]

Results: docs/results/blender.md.
"""

import argparse
import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from r5dgs_core.scene import scene_file  # noqa: E402  (the line before finds them)
from tests.blender import check_playback  # noqa: E402
from tests.support import scenes  # noqa: E402

WIDTH, HEIGHT, ROUNDS = 1280, 800, 3


def seconds(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Least processor time of several calls."""
    found = []
    for _ in range(rounds):
        started = time.process_time()
        work()
        found.append(time.process_time() - started)
    return min(found)


def view_of(strokes) -> object:
    """View of the whole scene."""
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    bpy.context.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.3, -7.0, 1.0), (1.45, 0.0, 0.05)
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = np.array(camera.calc_matrix_camera(depsgraph, x=WIDTH, y=HEIGHT))
    return strokes.StrokeView(projection @ np.linalg.inv(np.array(camera.matrix_world)), WIDTH, HEIGHT)


def main(count: int) -> None:
    """Print the times."""
    package = check_playback.extension_package()
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    with tempfile.TemporaryDirectory() as folder:
        path = scene_file.write(scenes.make_scene(n=count, objects=5, seed=1), Path(folder) / "scene.r5dgs")
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    collection = next(one for one in bpy.data.collections if one.r5dgs.is_scene)
    strokes = importlib.import_module(f"{package}.r5dgs_addon.clean_up.strokes")
    view, turns = view_of(strokes), np.linspace(0, 2 * np.pi, 300, endpoint=False)
    lasso = np.stack(
        [WIDTH / 2 + 350 * np.cos(turns) * (1 + 0.2 * np.sin(7 * turns)), HEIGHT / 2 + 250 * np.sin(turns)], -1
    )
    for front in (False, True):
        for name, route, radius in (("lasso", lasso, None), ("brush", lasso[:60], 40.0)):
            stroke = strokes.Stroke(route, radius, front)
            took = seconds(lambda one=stroke: strokes.select(bpy.context, collection, view, one, "SET"))
            print(f"{name:9} {'front' if front else 'through':8} {took:.3f} s")
    print(f"floaters           {seconds(bpy.ops.r5dgs.select_floaters):.3f} s")
    print(f"delete             {seconds(bpy.ops.r5dgs.delete_gaussians, 1):.3f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=300_000)
    main(parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else None).gaussians)

"""Processor time of selecting Gaussians in Blender by lasso, brush and criteria, and of deleting them.

Compares the number of Gaussians that strokes select with brute force, and exits with an error if they differ.

    python benchmarks/select_gaussians.py [--gaussians N]

Results: docs/results/blender.md.
"""

import argparse
import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from r5dgs_core.scene import scene_file  # noqa: E402  (the line before finds them)
from tests.blender import check_playback  # noqa: E402
from tests.support import scenes  # noqa: E402

WIDTH, HEIGHT, ROUNDS = 1280, 800, 3
MAX_DIFFERENT = 1e-4  # of the selected Gaussians, by rounding at edges


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


def project(collection, view) -> tuple[np.ndarray, ...]:
    """Pixels, depths, opacities and sizes of all Gaussians, by Blender's matrices. [n, 2], [n], [n], [n]"""
    found = []
    scale = 0.5 * HEIGHT * float(np.linalg.norm(view.matrix[1, :3]))
    for cloud in (one for one in collection.all_objects if one.r5dgs.role == "CLOUD"):
        columns = []
        for name, kind, width in (("position", "vector", 3), ("scale", "vector", 3), ("radiance:base", "color", 4)):
            values = np.empty(width * len(cloud.data.points), np.float32)
            cloud.data.attributes[name].data.foreach_get(kind, values)
            columns.append(values.reshape(-1, width).astype(np.float64))
        world = np.array(cloud.matrix_world)
        clip = np.column_stack([columns[0], np.ones(len(columns[0]))]) @ (view.matrix @ world).T
        pixels = (clip[:, :2] / clip[:, 3:] + 1) / 2 * (WIDTH, HEIGHT)
        sizes = scale * np.sqrt((columns[1] ** 2).mean(1)) / clip[:, 3]
        found.append((np.where(clip[:, 3:] > 0, pixels, np.nan), clip[:, 2] / clip[:, 3], columns[2][:, 3], sizes))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))


def expected(collection, view, stroke, view_selection) -> int:
    """Number of selected Gaussians by brute force: each against each edge, and front to back one by one."""
    pixels, depths, opacities, sizes = project(collection, view)
    inside = np.zeros(len(pixels), bool)
    x, y = pixels.T
    if stroke.radius is None:
        for (x0, y0), (x1, y1) in zip(stroke.path, np.roll(stroke.path, -1, axis=0), strict=True):
            crosses = (np.minimum(y0, y1) <= y) & (y < np.maximum(y0, y1))
            if y0 != y1:
                inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    else:
        for start, stop in pairwise(stroke.path):
            along = stop - start
            share = np.clip((pixels - start) @ along / (along @ along), 0, 1)
            inside |= ((pixels - start - share[:, None] * along) ** 2).sum(1) <= stroke.radius**2
    if not stroke.front:
        return int(inside.sum())
    low, high = pixels[inside].min(0) - 16, pixels[inside].max(0) + 16
    near = np.flatnonzero(((pixels >= low) & (pixels <= high)).all(1))
    cell = max(4.0, 2 * float(np.median(sizes[near])))
    light: dict[tuple[int, int], float] = {}
    count = 0
    for row in near[np.argsort(depths[near], kind="stable")]:
        key = int(pixels[row, 0] // cell), int(pixels[row, 1] // cell)
        left = light.get(key, 1.0)
        count += bool(inside[row] and left >= view_selection.FRONT)
        covered = min(np.pi * (2 * sizes[row]) ** 2 / cell**2, 1.0) * opacities[row]
        light[key] = left * (1 - min(covered, 0.999))
    return count


def main(count: int) -> None:
    """Print the times."""
    package = check_playback.extension_package()
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    with tempfile.TemporaryDirectory() as folder:
        path = scene_file.write(scenes.make_scene(n=count, objects=5, seed=1), Path(folder) / "scene.r5dgs")
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    collection = next(one for one in bpy.data.collections if one.r5dgs.is_scene)
    strokes = importlib.import_module(f"{package}.r5dgs_addon.clean_up.strokes")
    view_selection = importlib.import_module(f"{package}.r5dgs_addon.clean_up.view_selection")
    view, turns = view_of(strokes), np.linspace(0, 2 * np.pi, 300, endpoint=False)
    lasso = np.stack(
        [WIDTH / 2 + 350 * np.cos(turns) * (1 + 0.2 * np.sin(7 * turns)), HEIGHT / 2 + 250 * np.sin(turns)], -1
    )
    for front in (False, True):
        for name, route, radius in (("lasso", lasso, None), ("brush", lasso[:60], 40.0)):
            stroke = strokes.Stroke(route, radius, front)
            took = seconds(lambda one=stroke: strokes.select(bpy.context, collection, view, one, "SET"))
            selected = strokes.select(bpy.context, collection, view, stroke, "SET")
            wanted = expected(collection, view, stroke, view_selection)
            kind = "front" if front else "through"
            print(f"{name:9} {kind:8} {took:.3f} s, {selected:,} selected, {wanted:,} by brute force")
            if abs(selected - wanted) > MAX_DIFFERENT * max(wanted, 1):
                sys.exit("the selection differs from brute force")
    print(f"floaters           {seconds(bpy.ops.r5dgs.select_floaters):.3f} s")
    print(f"delete             {seconds(bpy.ops.r5dgs.delete_gaussians, 1):.3f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=300_000)
    main(parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else None).gaussians)

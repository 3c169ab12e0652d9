"""Time and memory of `r5dgs associate` on a large scene, by stage.

    python -m benchmarks.association large_scene [--json FILE]

A ring of cameras sees a synthetic scene whose Gaussians fill a box, so that nearly every camera draws all of them. Its
masks are degraded (`degraded_masks`, case D) and repaired by the code of the command. ``read_s``: reading the masks;
``draw_s``: rendering the segments; ``rest_s``: associating segments and mending masks. Wall time, kernels compiled
beforehand. Results: docs/results/association.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from r5dgs_core.association import mask_repair
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import masks as id_masks
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.render.warm_up import warm_up
from r5dgs_core.scene.scene import Scene
from tests.support import scenes

from . import degraded_masks
from .scenes import Image

CAMERAS = 10


def make_views(scene: Scene, images: int, pixels: int, folder: Path) -> tuple[list[datasets.View], list[Image]]:
    """Write degraded masks of a scene to a folder. Returns the views of the data set and the true masks."""
    views, truth, nothing = [], [], np.zeros((0, 1))
    for k in range(CAMERAS):
        camera = scenes.orbit_camera(2 * np.pi * k / CAMERAS, pixels, pixels)
        for i, t in enumerate(np.linspace(0, scene.t_max, images // CAMERAS)):
            ids = scene_renderer.render_frame(
                scene, scene_player.Player(scene).frame(float(t)), camera, background=None
            ).ids
            assert ids is not None
            truth.append(Image(k, i, np.maximum(ids, 0).astype(np.int32).reshape(-1), nothing, nothing))
            path = folder / f"camera{k}_{i:03d}.png"
            views.append(datasets.View(path.stem, camera, float(t), "train", path, path, mask_video=f"camera{k}"))
    for view, ids in zip(views, degraded_masks.spoil(truth, degraded_masks.CASES["D"], pixels, 7), strict=True):
        assert view.mask_path is not None
        id_masks.write(view.mask_path, ids.reshape(pixels, pixels))
    return views, truth


def measure(gaussians: int, objects: int, images: int, pixels: int) -> dict[str, float]:
    """Wall seconds of each stage, memory and mIoU."""
    warm_up()
    scene = scenes.make_scene(n=gaussians, objects=objects, sh_degree=0, seed=1, identities=False)
    small = scenes.make_scene(n=60, objects=2, sh_degree=0, seed=1, identities=False)
    with tempfile.TemporaryDirectory() as name:
        views, truth = make_views(scene, images, pixels, Path(name))
        incoming = [id_masks.read(view.mask_path).reshape(-1) for view in views]
        moments = {}

        def note(event: dict) -> None:
            moments[event["event"], event.get("done")] = time.perf_counter()

        dataset = datasets.Dataset(
            root=Path(name), name="large", train=tuple(views), val=(), test=(), object_names={}, object_aliases={},
            ground_truth=None, world_convention=scene.world_convention, frames_per_unit=1.0, has_alpha=False,
            digest="", mask_folder=Path(name),
        )  # fmt: skip
        mask_repair.repair(small, dataclasses.replace(dataset, train=tuple(views[:2])))  # compiles
        start = time.perf_counter()
        done = mask_repair.repair(scene, dataset, progress=note)
        end = time.perf_counter()
        mended = [mask.reshape(-1) for mask in done.mended]  # reads the masks of the data set
    found = {
        "read_s": moments["draw", 0] - start,
        "draw_s": moments["draw", len(views)] - moments["draw", 0],
        "rest_s": end - moments["draw", len(views)],
        "whole_s": end - start,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "in": degraded_masks.miou(incoming, truth),
        "out": degraded_masks.miou(mended, truth),
    }
    return {"gaussians": gaussians, "objects": objects, "images": len(views), "pixels": pixels} | {
        key: round(value, 3) for key, value in found.items()
    }


def main(arguments: list[str] | None = None) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=500_000)
    parser.add_argument("--objects", type=int, default=30)
    parser.add_argument("--images", type=int, default=200, help=f"a multiple of {CAMERAS}, the cameras")
    parser.add_argument("--pixels", type=int, default=400, help="of each side of an image")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    found = measure(options.gaussians, options.objects, options.images, options.pixels)
    for key, value in found.items():
        print(f"{key:>10}: {value}")
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Repair of degraded masks of synthetic scenes.

    python -m benchmarks.association synthetic --seeds judging

Synthetic scenes (`scenes`) are seen through misplaced Gaussians; their masks are degraded by tracker errors
(`degraded_masks`) and given to `associate.associate`. The columns are mIoU with one map of ids for all images
(`degraded_masks.miou`):

    in          the input masks
    majority    every Gaussian takes its most frequent id
    sequential  image by image with a fixed threshold (`sequential_baseline`)
    ours        with the new ids of the segments
    mended      with `association.mending`, too
    oracle      every segment takes the true object of most of its pixels

``found`` is the number of objects, ``precision`` and ``recall`` those of the listed switches, ``usual`` the median
overlap of a segment with the votes of the other images. ``--large`` measures time and memory instead. Results:
docs/results/association.md.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r5dgs_core.association import associate, mending, segment_stack

from . import degraded_masks, scenes, sequential_baseline

SEEDS = {"development": (1, 2, 3), "judging": (101, 102, 103, 104, 105)}
ERRORS_PX = (0.0, 0.7, 1.5, 3.0)
MODELS = ("drift", "jitter")
MEASURES = (
    *("in", "majority", "sequential", "ours", "mended", "oracle", "objects", "found", "precision", "recall"),
    *("confident", "usual", "fallback", "seconds"),
)
LARGE = scenes.SceneSettings(
    bodies=30, gaussians=360_000, floor=374, views=10, times=20, pixels=400, radius=(0.09, 0.13), extent=1.25
)


def measure(plan: scenes.SceneSettings, case: str, error_px: float, model: str, seed: int) -> dict[str, float]:
    """One run."""
    scene = scenes.make(plan, seed)
    images = list(scenes.observe(scene, error_px, model, seed + 1000))
    masks = degraded_masks.spoil(images, degraded_masks.CASES[case], plan.pixels, seed + 2000)
    count = len(scene.paths)
    start = time.process_time()
    given = [
        segment_stack.from_pixels(mask, image.indices, image.weights, count, view=image.view, time=image.time)
        for mask, image in zip(masks, images, strict=True)
    ]
    found = associate.associate(given)
    seconds = time.process_time() - start
    ours = [mending.relabel(mask, bag.ids, ids) for mask, bag, ids in zip(masks, given, found.ids, strict=True)]
    mended = []
    for k, (seen, shares) in enumerate(mending.shares(given, found)):
        table = np.zeros((count + 1, shares.shape[1]), np.float32)  # the last row for pixels' empty places
        table[seen] = shares
        drawn = np.einsum("pk,pkc->pc", images[k].weights, table[images[k].indices])
        mended.append(mending.mend(masks[k], given[k].ids, drawn, found, k))
    precision, recall = degraded_masks.switches(masks, images, found.rows)
    score = [
        degraded_masks.miou(version, images)
        for version in (
            masks,
            degraded_masks.majority(masks, images, count),
            sequential(masks, images, count),
            ours,
            mended,
            degraded_masks.oracle(masks, images),
        )
    ]
    seen_objects = len(np.unique(np.concatenate([np.unique(image.truth) for image in images]))) - 1
    rest = (seen_objects, len(found.objects), precision, recall, found.confident, found.usual_iou, found.fallback)
    return dict(zip(MEASURES, map(float, (*score, *rest, seconds)), strict=True))


def sequential(masks: Sequence[np.ndarray], images: Sequence[scenes.Image], count: int) -> list[np.ndarray]:
    """Masks relabelled by `sequential_baseline` from the Gaussian with the largest weight in each pixel."""
    given = [
        segment_stack.from_pixels(
            mask, image.indices[:, :1], np.ones_like(image.weights[:, :1]), count, view=image.view, time=image.time
        )
        for mask, image in zip(masks, images, strict=True)
    ]
    stack = segment_stack.stack(given)
    labels = np.maximum(sequential_baseline.associate(stack), 0)
    return [
        mending.relabel(mask, bag.ids, labels[stack.images == k])
        for k, (mask, bag) in enumerate(zip(masks, given, strict=True))
    ]


def large(seed: int) -> dict[str, float]:
    """Seconds and memory for 500 000 Gaussians in 200 images of 400 x 400, 30 objects, case D, 0.7 px."""
    scene = scenes.make(LARGE, seed)
    images = list(scenes.observe(scene, 0.7, "drift", seed + 1000))
    masks = degraded_masks.spoil(images, degraded_masks.CASES["D"], LARGE.pixels, seed + 2000)
    start = time.perf_counter()
    neighbours = nearest(scene.paths[:, 0])
    tree_s = time.perf_counter() - start
    start = time.perf_counter()
    given = [
        segment_stack.from_pixels(
            mask, image.indices, image.weights, len(scene.paths), view=image.view, time=image.time
        )
        for mask, image in zip(masks, images, strict=True)
    ]
    bags_s = time.perf_counter() - start
    images_mb = sum(i.indices.nbytes + i.weights.nbytes + i.truth.nbytes for i in images) / 2**20
    start = time.perf_counter()
    found = associate.associate(given, neighbours, paths=scene.paths[:, ::5])
    seconds = time.perf_counter() - start
    ours = [mending.relabel(mask, bag.ids, ids) for mask, bag, ids in zip(masks, given, found.ids, strict=True)]
    return {
        "gaussians": len(scene.paths),
        "images": len(images),
        "neighbours_s": tree_s,
        "bags_s": bags_s,
        "associate_s": seconds,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "of_which_images_mb": images_mb,
        "in": degraded_masks.miou(masks, images),
        "ours": degraded_masks.miou(ours, images),
        "oracle": degraded_masks.miou(degraded_masks.oracle(masks, images), images),
        "found": len(found.objects),
    }


def nearest(places: np.ndarray) -> np.ndarray:
    """The 8 nearest others of each Gaussian. [N, 3] -> [N, 8]"""
    from scipy import spatial

    return spatial.cKDTree(places).query(places, 9)[1][:, 1:]


def table(rows: Sequence[dict]) -> str:
    """Means over the seeds as Markdown, one line per cell."""
    names = (
        "in",
        "majority",
        "sequential",
        "ours",
        "mended",
        "oracle",
        "worst",
        "found",
        "precision",
        "recall",
        "usual",
    )
    lines = [
        "| scene | case | error px | model | " + " | ".join(names) + " |",
        "|" + "---|" * (len(names) + 4),
    ]
    cells: dict[tuple, list[dict]] = {}
    for row in rows:
        cells.setdefault((row["scene"], row["case"], row["error_px"], row["model"]), []).append(row)
    for (scene, case, error_px, model), members in cells.items():
        mean = {name: _mean([m[name] for m in members]) for name in MEASURES}
        mean["worst"] = min(m["ours"] - m["in"] for m in members)
        shown = [f"{mean['found']:.1f} / {mean['objects']:.1f}" if n == "found" else f"{mean[n]:.3f}" for n in names]
        lines.append(f"| {scene} | {case} | {error_px:g} | {model} | " + " | ".join(shown) + " |")
    return "\n".join(lines) + "\n"


def _mean(values: Sequence[float]) -> float:
    found = [value for value in values if not np.isnan(value)]
    return float(np.mean(found)) if found else np.nan


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=",".join(scenes.PLANS), help="names in scenes.py")
    parser.add_argument("--cases", default=",".join(degraded_masks.CASES), help="names in degraded_masks.py")
    parser.add_argument("--errors", default=",".join(map(str, ERRORS_PX)), help="of the geometry, pixels")
    parser.add_argument("--models", default=",".join(MODELS), help="models of the error in scenes.py")
    parser.add_argument("--seeds", default="development", help="development, judging, or numbers")
    parser.add_argument("--large", action="store_true", help="measure time and memory of a large scene instead")
    parser.add_argument("--out", type=Path, help="write OUT.json and OUT.md, too")
    options = parser.parse_args(arguments)
    if options.out and not options.out.parent.is_dir():
        parser.error(f"--out: no folder {options.out.parent}")
    if options.large:
        found = {key: round(value, 3) for key, value in large(1).items()}
        print(json.dumps(found, indent=1))
        if options.out:
            options.out.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")
        return
    seeds = SEEDS.get(options.seeds) or tuple(map(int, options.seeds.split(",")))
    rows = []
    for scene in options.scenes.split(","):
        for case in options.cases.split(","):
            for error_px in map(float, options.errors.split(",")):
                for model in options.models.split(","):
                    if not error_px and model != options.models.split(",")[0]:
                        continue  # without an error there is nothing to model
                    for seed in seeds:
                        found = measure(scenes.PLANS[scene], case, error_px, model, seed)
                        row = {"scene": scene, "case": case, "error_px": error_px, "model": model, "seed": seed}
                        rows.append(row | {key: round(value, 4) for key, value in found.items()})
                    print(table(rows[-len(seeds) :]).splitlines()[-1], flush=True)
    if options.out:
        options.out.with_suffix(".json").write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n")
        options.out.with_suffix(".md").write_text(table(rows))


if __name__ == "__main__":
    main()

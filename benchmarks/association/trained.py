"""Effect of degraded and of repaired masks on training.

    python -m benchmarks.association trained DATA --out DIR [--seed 0] [--switches 0.03] [--misses 0.05]
                                                            [--iterations 6000] [--json FILE]

The training masks of a data set are degraded: each camera has its own numbering, ids are switched permanently, objects
are missed. A run without masks repairs them (``r5dgs associate``). Three runs are compared: with true, degraded and
repaired masks. Overlaps are means over objects, after the best map of ids per split, against the masks of held-out
views. Results: docs/results/association.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from r5dgs_core.bake import bake
from r5dgs_core.cli.commands import associate
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import mask_notes, masks, view_masks
from r5dgs_core.evaluation import evaluate
from r5dgs_core.masks import videos
from r5dgs_core.train import run

from . import degraded_masks
from .scenes import Image


def spoil(dataset: datasets.Dataset, folder: Path, errors: degraded_masks.Errors, seed: int) -> None:
    """Write the training masks with errors, and a `masks.json` that declares numbering per video."""
    shots = videos.of(dataset.train)
    views = [(k, i, view) for k, video in enumerate(shots) for i, view in enumerate(video.views)]
    truth = [datasets.load_mask(view) for _, _, view in views]
    if any(ids is None for ids in truth):
        raise SystemExit(f"{dataset.root}: expected a true mask for every training view")
    nothing = np.zeros((0, 1))
    images = [Image(k, i, ids.reshape(-1), nothing, nothing) for (k, i, _), ids in zip(views, truth, strict=True)]
    spoilt = degraded_masks.spoil(images, errors, truth[0].shape[1], seed)
    for (_, _, view), ids, true in zip(views, spoilt, truth, strict=True):
        masks.write(folder / f"{view.name}.png", ids.reshape(true.shape))
    found = {}
    for k, video in enumerate(shots):
        ids = {int(i) for (at, _, _), mask in zip(views, spoilt, strict=True) if at == k for i in np.unique(mask)}
        found[video.name] = mask_notes.Video(tuple(view.name for view in video.views), tuple(sorted(ids - {0})))
    mask_notes.write(mask_notes.MaskNotes("benchmark", mask_notes.VIDEO, videos=found), folder)


def overlap(data: Path, folder: Path) -> float:
    """Mean IoU of training masks with the true ones, over objects, after the one best map of ids."""
    true, other = datasets.read(data), datasets.read(data, str(folder))
    nothing = np.zeros((0, 1))
    images = [Image(0, 0, datasets.load_mask(view).reshape(-1), nothing, nothing) for view in true.train]
    return degraded_masks.miou([datasets.load_mask(view).reshape(-1) for view in other.train], images)


def train(data: Path, train_masks: str, folder: Path, iterations: int, seed: int) -> dict[str, Any]:
    """Train, bake and measure one run; continues an existing one."""
    settings = config.Config().replace(
        **{"train.iterations": iterations, "train.seed": seed, "data.masks": train_masks}
    )
    done = run.train(data, folder, settings, resume=(folder / "run.json").exists())
    dataset = datasets.read(data)
    splits = evaluate.evaluate(bake.bake(done), dataset)["splits"]
    return {split: {key: splits[split]["rigid"][key] for key in ("miou_matched", "psnr")} for split in ("val", "test")}


def main(arguments: list[str] | None = None) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with true masks in every split")
    parser.add_argument("--out", type=Path, required=True, help="folder of masks and runs; existing ones are kept")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--switches", type=float, default=0.03)
    parser.add_argument("--misses", type=float, default=0.05)
    parser.add_argument("--iterations", type=int, default=6000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    data, out = args.data.resolve(), args.out.resolve()
    errors = degraded_masks.Errors(per_view=True, switches=args.switches, misses=args.misses)
    spoilt, plain, associated = out / "spoilt", out / "spoilt_unnoted", out / "associated"
    dataset = datasets.read(data)
    spoil(dataset, spoilt, errors, args.seed)
    for view in dataset.train:  # the same without notes: training refuses masks that say how they are numbered
        (plain / view.name).parent.mkdir(parents=True, exist_ok=True)
        (plain / f"{view.name}.png").write_bytes((spoilt / f"{view.name}.png").read_bytes())
    options = {"iterations": args.iterations, "seed": args.seed}
    train(data, view_masks.NO_MASKS, out / "without", **options)
    associate.run_associate(out / "without", data, masks=spoilt, out=associated)
    rows = {
        "true masks": {"masks": 1.0, **train(data, datasets.MASKS, out / "true", **options)},
        "degraded": {
            "masks": overlap(data, spoilt),
            **train(data, str(plain), out / "spoilt_run", **options),
        },
        "associated": {
            "masks": overlap(data, associated),
            **train(data, str(associated), out / "associated_run", **options),
        },
    }
    print("| masks | their mIoU | val mIoU | test mIoU | val dB | test dB |\n|---|---|---|---|---|---|")
    for name, row in rows.items():
        scores = [row["masks"], row["val"]["miou_matched"], row["test"]["miou_matched"]]
        scores_db = [row["val"]["psnr"], row["test"]["psnr"]]
        print(
            f"| {name} | "
            + " | ".join([*(f"{score:.3f}" for score in scores), *(f"{db:.2f}" for db in scores_db)])
            + " |"
        )
    if args.json is not None:
        result = {"data": dataset.name, "seed": args.seed, "switches": args.switches, "misses": args.misses, **options}
        args.json.write_text(json.dumps(result | {"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""The command ``r5dgs associate``: make mask ids consistent across images and videos."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, folder_lock, input_paths
from .. import inputs, options

if TYPE_CHECKING:
    from ...association.mask_repair import Repair

SHOWN = 12  # maximum number of changes to print


NAME = "associate"
SHORT = "make mask ids consistent across images and videos"
LONG = "Correct masks whose ids are switched, split or numbered per video, by the geometry and motion of a run."
EXAMPLE = "RUN --masks FOLDER"
PAGE = "user/associate.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    target = "run folder (best trained without masks) or .r5dgs file"
    p.add_argument("target", type=Path, metavar="RUN|SCENE", help=target)
    p.add_argument("--data", type=Path, metavar="DIR", help="data set (default: the run's own)")
    incoming = "masks to correct (default: those of the run, or DATA/object_mask if it was trained without masks)"
    p.add_argument("--masks", type=Path, metavar="FOLDER", help=incoming)
    p.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: RUN/object_mask)")
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"masks": args.masks, "out": args.out, "threads": args.threads, "progress_kind": args.progress}
    run_associate(args.target, args.data, **given)


@folder_lock.writes("out", "target")
def run_associate(
    target: Path,
    data: Path | None = None,
    *,
    masks: Path | None = None,
    out: Path | None = None,
    threads: int | None = None,
    progress_kind: str = "none",
) -> Path:
    """Renumber mask segments by the geometry and motion of a trained scene.

    Args:
        target: Run folder, or ``.r5dgs`` file with ``data`` and ``out``. Its Gaussians link segments across images.
        data: Data set; that of the run if None.
        masks: Folder of the incoming masks; those of the run if None, or ``DATA/object_mask`` if it was trained without
            masks.
        out: Folder to write; ``RUN/object_mask`` if None.
        threads: Threads of the kernels; see `options.use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The written folder.

    Raises:
        ConfigError, DatasetError, CheckpointError, SceneFileError: An input cannot be used.
    """
    inputs.check_target(target, data)
    if target.is_file() and (data is None or out is None):
        raise errors.UsageError(f"associate {target}: a scene file requires the options --data and --out")
    if out is not None:
        input_paths.check_output_folder("--out", out)
    from ...association import mask_repair
    from ...data import dataset as datasets
    from ...progress import make

    options.use_threads(threads)
    with make(progress_kind) as progress:
        progress({"event": "prepare", "text": "the scene"})
        scene, dataset = inputs.open_target(target, data)
        assert dataset is not None
        folder = (Path(out) if out is not None else target / datasets.MASKS).resolve()
        if masks is not None or dataset.mask_folder is None:
            dataset = datasets.read(dataset.root, datasets.MASKS if masks is None else str(Path(masks).resolve()), 0.0)
            dataset = dataset.relative_to(scene.origin)
        assert dataset.mask_folder is not None
        if folder == dataset.mask_folder.resolve():
            raise errors.ConfigError(f"--out {folder}: holds the incoming masks; name another folder")
        mask_repair.check_place(folder, dataset.train)
        done = mask_repair.repair(scene, dataset, progress=progress)
        names = {} if done.own_ids else dataset.object_names if dataset.own_ids else None
        made_with = {"scene": str(target.resolve()), "masks": str(dataset.mask_folder.resolve())}
        unmasked = [view for view in dataset.train if view.mask_path is None]
        summary = mask_repair.write(done, folder, names, made_with, unmasked)
        if progress_kind == "json":
            progress({"event": "associated", "path": str(folder), **summary})
    if progress_kind != "json":
        _print_summary(done, summary, folder, dataset.root)
    return folder


def _print_summary(done: Repair, summary: dict[str, Any], folder: Path, root: Path) -> None:
    """Print a summary of the changes and the next step."""
    from ...association import mask_repair

    counted = ("segments", "images", "relabelled", "unknown", "kept")
    segments, images, relabelled, unknown, kept = (summary[key] for key in counted)
    print(
        f"{segments} segments in {images} images: {relabelled} relabelled, {unknown} unknown, {kept} kept; "
        f"{len(summary['objects'])} objects"
    )
    if summary["mended"]:
        print(f"in {summary['mended']} images, objects without a segment were filled in from the other images")
    print(
        f"mean IoU of segments with their objects in other images: {summary['agreement']:.2f}; "
        f"with the incoming ids: {summary['agreement_before']:.2f}"
    )
    if summary["fallback"]:
        print("the incoming ids are kept: the evidence is too weak, or new ids would not agree better")
    changed = mask_repair.switches(done)
    for row in changed[:SHOWN]:
        new = "unknown here" if row.done == "unknown" else f"object {row.new_id} here"
        usual = f", mostly object {row.usual_id} in its video" if row.usual_id > 0 else ""
        figures = f"{row.pixels} pixels, score {row.score:.2f}"
        print(f"  {done.views[row.image].name}: id {row.old_id} is {new}{usual} ({figures})")
    if len(changed) > SHOWN:
        print(f"  and {len(changed) - SHOWN} more in {folder / mask_repair.SEGMENTS}")
    print(f"written: {folder}")
    if done.numbering == "scene":
        print(f"Next: r5dgs train {root} --masks {folder} --out RUN")
    else:
        print("the ids are valid only within single videos, so training cannot use them: train longer, or add images")

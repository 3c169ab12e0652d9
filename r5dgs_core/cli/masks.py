"""The command ``r5dgs masks``: make masks for the training images of a data set, or check existing ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .. import errors, user_settings
from . import runs

if TYPE_CHECKING:
    from ..masks.make_masks import Made

BACKENDS = ("precomputed", "blender", "sam2")


def run_masks(
    data: Path,
    *,
    backend: str = "precomputed",
    model: Path | None = None,
    source: Path | None = None,
    out: Path | None = None,
    key_frames: int | None = None,
    points: int | None = None,
    score: float | None = None,
    stability: float | None = None,
    max_area: float | None = None,
    device: str | None = None,
    unknown: int | None = None,
    overwrite: bool = False,
    progress_kind: str = "none",
) -> Made:
    """Write masks of the training images; if source and output are the same folder, check them instead.

    Args:
        data: The data set.
        backend: Source of the masks, from `BACKENDS`.
        model: Folder of the SAM2 weights.
        source: Folder of masks (``precomputed``) or of a captured data set (``blender``); the data set itself if None.
        out: Folder to write; ``DATA/object_mask`` if None.
        key_frames: Images per video in which ``sam2`` searches for all objects.
        points: Side length of SAM2's grid of point prompts.
        score: Minimum quality that SAM2 predicts for a mask.
        stability: Minimum stability score of a mask.
        max_area: Maximum area of an object, as a share of the image; larger masks are background.
        device: Device that runs SAM2, "cpu" or "cuda".
        unknown: Source value of pixels whose object is unknown.
        overwrite: Replace existing masks.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        Summary of the written or checked masks.

    Raises:
        ConfigError, DatasetError, BackendError: An input cannot be used.
        Interrupted: Ctrl-C; finished videos are kept.
    """
    tuned = {"points": points, "score": score, "stability": stability, "max_area": max_area}
    tuned = {name: value for name, value in tuned.items() if value is not None}
    if backend == "sam2" and model is None:
        model = _user_model()
    _check(backend, model, source, device, unknown, {"key_frames": key_frames, **tuned})
    runs.check_dataset(data)
    from ..data import dataset as datasets
    from ..data import mask_notes, view_masks
    from ..masks import make_masks
    from ..progress import make

    dataset = datasets.read(data, view_masks.NO_MASKS, min_registered=0.0)
    folder = dataset.root / datasets.MASKS if out is None else Path(out)
    views = dataset.train
    if backend == "sam2":
        from ..masks import sam2_masks, sam2_segments
        from ..masks.sam2_model import Sam2

        assert model is not None
        track = sam2_masks.TrackSettings() if key_frames is None else sam2_masks.TrackSettings(key_frames)
        segment = sam2_segments.SegmentSettings(**tuned)  # type: ignore[arg-type]
        maker = sam2_masks.Sam2Masks(Sam2(model, device or "cpu"), segment, track)
        in_place = False
    else:
        from ..masks import mask_folders

        own = source if source is not None else dataset.root
        if backend == "blender":
            maker = mask_folders.Captured(own, views)
        else:
            maker = mask_folders.Precomputed(own if source is not None else own / datasets.MASKS, views, unknown)
        in_place = maker.folder.resolve() == folder.resolve()
        if in_place and unknown is not None and unknown != mask_notes.read(folder).unknown:
            raise errors.ConfigError(
                f"--unknown {unknown}: nothing would be written here, so training would not know this value. Remedy: "
                f"write to another folder with --out, or record it in {folder / mask_notes.FILE}: "
                f'{{"format_version": 1, "unknown": {unknown}}}'
            )
    with make(progress_kind) as progress:
        if in_place:
            made = make_masks.check(views, maker, folder, progress=progress)
        else:
            try:
                made = make_masks.make(views, maker, folder, overwrite=overwrite, progress=progress)
            except KeyboardInterrupt as stop:
                raise errors.Interrupted(
                    f"stopped; finished videos are kept in {folder}, run the same command again to continue"
                ) from stop
        if progress_kind == "json":
            progress({"event": "masked", "path": str(folder), "images": made.images, "objects": made.objects})
    if progress_kind != "json":
        print(_summary(made, len(views), in_place, dataset.root))
    return made


def _user_model() -> Path | None:
    found = user_settings.read().get("sam2")
    return None if found is None else Path(found)


def _check(
    backend: str,
    model: Path | None,
    source: Path | None,
    device: str | None,
    unknown: int | None,
    tuned: dict[str, int | float | None],
) -> None:
    """Raise UsageError for options that do not fit the backend, and for values out of range."""
    if backend not in BACKENDS:
        raise errors.UsageError(f"--backend {backend}: expected one of {', '.join(BACKENDS)}")
    if backend == "sam2":
        if model is None:
            raise errors.UsageError(
                "--backend sam2: name the folder of the model with --model DIR, or once with "
                "'r5dgs config --user set sam2 DIR' (docs/user/masks.md)"
            )
        misplaced = {"--from": source, "--unknown": unknown}
    else:
        misplaced = {"--model": model, "--device": device}
        misplaced |= {"--" + name.replace("_", "-"): value for name, value in tuned.items()}
        if backend == "blender":
            misplaced["--unknown"] = unknown
    for option, value in misplaced.items():
        if value is not None:
            raise errors.UsageError(f"{option}: is not for --backend {backend}")
    for name, value in tuned.items():
        option = "--" + name.replace("_", "-")
        if value is not None and name in ("key_frames", "points") and not 1 <= value <= 1024:
            raise errors.UsageError(f"{option} {value}: expected a number from 1 to 1024")
        if value is not None and name not in ("key_frames", "points") and not 0 <= value <= 1:
            raise errors.UsageError(f"{option} {value}: expected a share from 0 to 1")


def _summary(made: Made, wanted: int, in_place: bool, root: Path) -> str:
    """Return the summary of the masks and the next step."""
    from ..data import dataset as datasets
    from ..data import mask_notes

    objects = "1 object" if made.objects == 1 else f"{made.objects} objects"
    lines = [f"{made.folder}: masks of {made.images} of {wanted} training images, {objects}"]
    if made.kept:
        lines[0] += f"; {made.kept} of {made.videos} videos were done before"
    if made.unknown:
        lines.append(f"{100 * made.unknown:.1f} % of the pixels are unknown")
    if in_place:
        lines.append("all masks can be read; nothing was written")
    if made.numbering == mask_notes.VIDEO and made.videos > 1:
        own = "" if made.folder == root / datasets.MASKS else f" --masks {made.folder}"
        lines.append(
            f"ids are valid within each of {made.videos} videos only. Next: r5dgs train {root} --masks none --out RUN, "
            f"then r5dgs associate RUN{own}"
        )
    return "\n".join(lines)

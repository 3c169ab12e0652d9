"""The command ``r5dgs masks``: make masks for the training images of a data set, or check existing ones."""

from __future__ import annotations

import argparse
import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, user_settings
from .. import inputs, options

if TYPE_CHECKING:
    from ...data.dataset import Dataset
    from ...data.views import View
    from ...masks.make_masks import MaskingResult

NAME = "masks"
SHORT = "make or check the masks of the training images"
LONG = "Make object masks from image features or with SAM2 or SAM3, convert masks, or check those of a data set."
EXAMPLE = "DATA --backend sam2 --model SAM2_FOLDER"
PAGE = "user/masks.md"

BACKENDS = ("precomputed", "blender", "features", "sam2", "sam3")
MAKERS = ("features", "sam2", "sam3")  # backends that make masks from the images

log = logging.getLogger(__name__)


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("data", type=Path, help="data set folder")
    made = "source of the masks: precomputed (a folder; default), blender (a captured data set), features, sam2 or sam3"
    p.add_argument("--backend", default="precomputed", metavar="NAME", help=made)
    source = "folder of the masks (precomputed), or captured data set (blender)"
    p.add_argument("--from", dest="source", type=Path, metavar="FOLDER", help=source)
    model = "folder of the weights of sam2 (default: that of 'r5dgs config --user') or sam3"
    p.add_argument("--model", type=Path, metavar="DIR", help=model)
    words = 'objects that sam3 searches for, one phrase per object, such as "mug, red apple"'
    p.add_argument("--words", metavar="WORDS", help=words)
    p.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: DATA/object_mask)")
    key_frames = "images per video in which sam2 searches for all objects (default: 3)"
    p.add_argument("--key-frames", type=int, metavar="N", help=key_frames)
    points = "points along each side of the prompt grid of sam2 (default: 32)"
    p.add_argument("--points", type=int, metavar="N", help=points)
    score = "minimum quality that sam2 predicts for a mask, 0 to 1 (default: 0.8)"
    p.add_argument("--score", type=float, metavar="SHARE", help=score)
    stability = "minimum IoU of a mask at two thresholds, 0 to 1 (default: 0.95)"
    p.add_argument("--stability", type=float, metavar="SHARE", help=stability)
    max_area = "maximum area of an object as a share of the image; larger masks are background (default: 0.4)"
    p.add_argument("--max-area", type=float, metavar="SHARE", help=max_area)
    p.add_argument("--device", metavar="NAME", help="device that runs sam2 or sam3: cpu (default) or cuda")
    unknown = "mask value of pixels whose object is unknown, for example 255"
    p.add_argument("--unknown", type=int, metavar="VALUE", help=unknown)
    p.add_argument("--overwrite", action="store_true", help="replace existing masks")
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {field.name: getattr(args, field.name) for field in dataclasses.fields(Options)}
    run_masks(args.data, progress_kind=args.progress, **given)


@dataclass(frozen=True)
class Options:
    """Options of `run_masks`; None stands for the default.

    Attributes:
        backend: Source of the masks, from `BACKENDS`.
        model: Folder of the weights; for SAM2, that of the user's settings if None.
        words: Phrases that SAM3 searches for, separated by commas.
        source: Folder of masks (``precomputed``) or of a captured data set (``blender``); the data set itself if None.
        out: Folder to write; ``DATA/object_mask`` if None.
        key_frames: Images per video in which ``sam2`` searches for all objects.
        points: Side length of SAM2's grid of point prompts.
        score: Minimum quality that SAM2 predicts for a mask.
        stability: Minimum stability score of a mask.
        max_area: Maximum area of an object, as a share of the image; larger masks are background.
        device: Device that runs SAM2 or SAM3, "cpu" or "cuda".
        unknown: Source value of pixels whose object is unknown.
        overwrite: Replace existing masks.
    """

    backend: str = "precomputed"
    model: Path | None = None
    words: str | None = None
    source: Path | None = None
    out: Path | None = None
    key_frames: int | None = None
    points: int | None = None
    score: float | None = None
    stability: float | None = None
    max_area: float | None = None
    device: str | None = None
    unknown: int | None = None
    overwrite: bool = False

    def segmentation(self) -> dict[str, int | float]:
        """Return the fields of `masks.sam2_segments.SegmentSettings` that are given."""
        names = ("points", "score", "stability", "max_area")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def run_masks(data: Path, *, progress_kind: str = "none", **fields: Any) -> MaskingResult:
    """Write masks of the training images; if source and output are the same folder, check them instead.

    Args:
        data: The data set.
        progress_kind: Form of progress output (`progress.make`).
        **fields: Fields of `Options`.

    Returns:
        Summary of the written or checked masks.

    Raises:
        ConfigError, DatasetError, BackendError: An input cannot be used.
        Interrupted: Ctrl-C; finished videos are kept.
    """
    given = checked(Options(**fields))
    inputs.check_dataset(data)
    from ...data import dataset as datasets
    from ...data import view_masks
    from ...progress import make

    dataset = datasets.read(data, view_masks.NO_MASKS, min_registered=0.0)
    folder = dataset.root / datasets.MASKS if given.out is None else Path(given.out)
    maker = _maker(dataset, given)
    in_place = given.backend not in MAKERS and maker.folder.resolve() == folder.resolve()
    if in_place:
        _check_unknown(given.unknown, folder)
    with make(progress_kind) as progress:
        made = _make(dataset.train, maker, folder, in_place, given.overwrite, progress)
        if progress_kind == "json":
            progress({"event": "masked", "path": str(folder), "images": made.images, "objects": made.objects})
    if progress_kind != "json":
        print(_summary(made, len(dataset.train), in_place, dataset.root))
    return made


def _maker(dataset: Dataset, given: Options) -> Any:
    """Return the `masks.make_masks.MaskBackend` of the options."""
    if given.backend == "sam2":
        from ...masks import sam2_masks, sam2_segments
        from ...masks.sam2_model import Sam2

        assert given.model is not None
        keys = {} if given.key_frames is None else {"key_frames": given.key_frames}
        segment = sam2_segments.SegmentSettings(**given.segmentation())  # type: ignore[arg-type]
        return sam2_masks.Sam2Masks(Sam2(given.model, given.device or "cpu"), segment, sam2_masks.TrackSettings(**keys))
    if given.backend == "sam3":
        from ...masks import sam3_masks
        from ...masks.sam3_model import LICENCE, Sam3

        assert given.model is not None
        log.info("the weights of SAM3 are under %s; read it", LICENCE)
        return sam3_masks.Sam3Masks(Sam3(given.model, given.device or "cpu"), phrases(given.words))
    if given.backend == "features":
        from ...masks import feature_masks

        return feature_masks.FeatureMasks(dataset.train)
    from ...data import dataset as datasets
    from ...masks import mask_folders

    if given.backend == "blender":
        return mask_folders.CapturedMasks(given.source or dataset.root, dataset.train)
    source = given.source or dataset.root / datasets.MASKS
    return mask_folders.PrecomputedMasks(source, dataset.train, given.unknown)


def phrases(words: str | None) -> list[str]:
    """Split ``--words`` at its commas. Raises UsageError if there is no phrase, or one occurs twice."""
    found = [" ".join(phrase.split()) for phrase in (words or "").split(",") if phrase.strip()]
    if not found:
        raise errors.UsageError('--backend sam3: name the objects with --words, such as --words "mug, red apple"')
    twice = next((phrase for k, phrase in enumerate(found) if phrase in found[:k]), None)
    if twice is not None:
        raise errors.UsageError(f"--words: {twice!r} occurs twice; a phrase names one object")
    return found


def _make(
    views: Sequence[View], maker: Any, folder: Path, in_place: bool, overwrite: bool, progress: Any
) -> MaskingResult:
    """Make masks, or check them if they are in place."""
    from ...masks import make_masks

    if in_place:
        return make_masks.check(views, maker, folder, progress=progress)
    try:
        return make_masks.make(views, maker, folder, overwrite=overwrite, progress=progress)
    except KeyboardInterrupt as stop:
        raise errors.Interrupted(
            f"stopped; finished videos are kept in {folder}, run the same command again to continue"
        ) from stop


def _check_unknown(unknown: int | None, folder: Path) -> None:
    """Raise ConfigError if --unknown differs from the value in the masks' notes (masks.json)."""
    from ...data import mask_notes

    if unknown is not None and unknown != mask_notes.read(folder).unknown:
        raise errors.ConfigError(
            f"--unknown {unknown}: the masks are already in {folder} and are not written again, so training would not "
            "learn of this value. Remedy: write to another folder with --out, or record it in "
            f"{folder / mask_notes.FILE}: "
            f'{{"format_version": 1, "unknown": {unknown}}}'
        )


def _user_model() -> Path | None:
    found = user_settings.read().get("sam2")
    return None if found is None else Path(found)


def checked(given: Options) -> Options:
    """Return the options, with the model of the user's settings if SAM2 needs one.

    Raises:
        UsageError: An option does not fit the backend, or a value is out of range.
    """
    if given.backend == "sam2" and given.model is None:
        given = dataclasses.replace(given, model=_user_model())
    _check(given)
    return given


def _check(given: Options) -> None:
    if given.backend not in BACKENDS:
        raise errors.UsageError(f"--backend {given.backend}: expected one of {', '.join(BACKENDS)}")
    tuned = {"key_frames": given.key_frames, **given.segmentation()}
    tuned = {"--" + name.replace("_", "-"): value for name, value in tuned.items() if value is not None}
    if given.backend == "sam2":
        if given.model is None:
            raise errors.UsageError(
                "--backend sam2: name the folder of the model with --model DIR, or once with "
                "'r5dgs config --user set sam2 DIR' (docs/user/masks.md)"
            )
        misplaced = {"--from": given.source, "--unknown": given.unknown, "--words": given.words}
    elif given.backend == "sam3":
        if given.model is None:
            raise errors.UsageError(
                "--backend sam3: name the folder of the model with --model DIR (docs/user/masks.md)"
            )
        phrases(given.words)
        misplaced = {"--from": given.source, "--unknown": given.unknown, **tuned}
    else:
        misplaced = {"--model": given.model, "--device": given.device, "--words": given.words, **tuned}
        if given.backend in ("blender", "features"):
            misplaced["--unknown"] = given.unknown
        if given.backend == "features":
            misplaced["--from"] = given.source
    for option, value in misplaced.items():
        if value is not None:
            raise errors.UsageError(f"{option}: does not apply to --backend {given.backend}")
    for option, value in tuned.items():
        if option in ("--key-frames", "--points"):
            if not 1 <= value <= 1024:
                raise errors.UsageError(f"{option} {value}: expected a number from 1 to 1024")
        elif not 0 <= value <= 1:
            raise errors.UsageError(f"{option} {value}: expected a share from 0 to 1")


def _summary(made: MaskingResult, wanted: int, in_place: bool, root: Path) -> str:
    """Return the summary of the masks and the next step."""
    from ...data import dataset as datasets
    from ...data import mask_notes

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

"""The command ``r5dgs prepare``: make a data set from videos or folders of frames."""

from __future__ import annotations

import argparse
import dataclasses
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, findings, input_paths, terminal
from .. import options

if TYPE_CHECKING:
    from ...prepare.plan import Plan

NAME = "prepare"
SHORT = "make a data set from videos or frames"
LONG = (
    "Make a data set from videos or folders of frames, one per camera: choose frames, compare clocks, undistort, make\n"
    "masks, and check the capture. Run the same command again to continue an interrupted one."
)
EXAMPLE = "VIDEOS --calibration calibration.toml --out DATA"
PAGE = "user/your_data.md"
SYNC = ("auto", "audio", "motion", "none")
_NO_FOLDER = ("none", "features", "sam2", "sam3")  # values of --masks that name no folder
NOT_RECORDED = ("D53",)  # findings about the machine, not about the capture


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("source", type=Path, help="folder with a video or a folder of frames per camera, or one video")
    p.add_argument("--out", type=Path, required=True, metavar="DATA", help="data set folder to write")
    _add_cameras(p)
    start = "first time, in seconds from the first time at which all cameras record (default: 0)"
    p.add_argument("--start", type=options.not_negative, default=0.0, metavar="S", help=start)
    p.add_argument("--end", type=options.positive, metavar="S", help="last time in seconds (default: the last frame)")
    p.add_argument("--every", type=options.at_least(1), default=1, metavar="N", help="use every N-th frame")
    p.add_argument("--fps", type=options.frame_rate, metavar="HZ", help="use at most this number of frames per second")
    size = "height of the images in pixels (default: up to 960, if training then fits half of the memory)"
    p.add_argument("--size", type=options.at_least(16), metavar="LINES", help=size)
    p.add_argument("--lossless", action="store_true", help="write PNG instead of JPEG of quality 95")
    rate = "recorded frames per second, for folders of frames and for videos with wrong times"
    p.add_argument("--rate", type=options.frame_rate, metavar="HZ", help=rate)
    sync = "source of the offsets between clocks: audio, motion, none or auto (default)"
    p.add_argument("--sync", choices=SYNC, default="auto", help=sync)
    offset = "known offset of a camera's clock in milliseconds, which is added to its times; may be repeated"
    p.add_argument("--offset", action="append", default=[], metavar="CAMERA=MS", help=offset)
    _add_hold_out(p)
    masks = "masks: a folder with a mask per frame (CAMERA/FRAME.png), features, sam2, sam3 or none (default)"
    p.add_argument("--masks", default="none", metavar="FOLDER|features|sam2|sam3|none", help=masks)
    p.add_argument("--model", type=Path, metavar="DIR", help="folder of the weights of sam2 or sam3")
    words = 'objects that sam3 searches for, one phrase per object, such as "mug, red apple"'
    p.add_argument("--words", metavar="WORDS", help=words)
    p.add_argument("--overwrite", action="store_true", help="replace a data set that was prepared with other settings")
    options.add_progress(p)


def _add_cameras(p: argparse.ArgumentParser) -> None:
    calibration = "file or folder of the cameras' calibration (default: found in the source, else reconstructed)"
    p.add_argument("--calibration", type=Path, metavar="FILE", help=calibration)
    board = "board in the recordings, from which the cameras are reconstructed; see docs/reference/prepare.md"
    p.add_argument("--board", metavar="KIND:COLUMNSxROWS:LENGTH:DETAIL:MARKERS", help=board)
    p.add_argument("--lenses", type=Path, metavar="FILE", help="calibration whose lenses, but not poses, are used")
    p.add_argument("--shared-lens", action="store_true", help="all cameras have the same lens and zoom")
    moving = "this camera moves, as a single camera always does; may be repeated"
    p.add_argument("--moving", action="append", default=[], metavar="CAMERA", help=moving)
    distance = "distance between two cameras without a calibration, in metres"
    p.add_argument("--distance", nargs=3, metavar=("CAMERA", "CAMERA", "M"), help=distance)
    scale = "metres per unit of the cameras' world (default: that of the calibration)"
    p.add_argument("--scale", type=options.positive, metavar="M", help=scale)
    up = "up direction of the world: cameras, plane, board or x,y,z (default: that of the calibration, else cameras)"
    p.add_argument("--up", metavar="UP", help=up)


def _add_hold_out(p: argparse.ArgumentParser) -> None:
    camera = "keep the frames of this camera for evaluation; may be repeated"
    p.add_argument("--hold-out-camera", action="append", default=[], metavar="CAMERA", help=camera)
    every = "keep every N-th time for evaluation"
    p.add_argument("--hold-out-every", type=options.at_least(2), metavar="N", help=every)
    after = "keep the frames after this time for evaluation, in seconds from the first frame"
    p.add_argument("--hold-out-after", type=options.positive, metavar="S", help=after)
    horizon = "seconds of the scene after its last observed time (default: a quarter of the observed time)"
    p.add_argument("--horizon", type=options.not_negative, metavar="S", help=horizon)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    window = {"start": args.start, "end": args.end, "every": args.every, "fps": args.fps}
    hold_out = {
        "cameras": tuple(args.hold_out_camera),
        "every": args.hold_out_every,
        "after": args.hold_out_after,
        "horizon": args.horizon,
    }
    run_prepare(
        args.source,
        args.out,
        window=window,
        hold_out=hold_out,
        progress_kind=args.progress,
        calibration=args.calibration,
        lines=args.size,
        lossless=args.lossless,
        sync=args.sync,
        offsets=_offsets(args.offset),
        rate=args.rate,
        overwrite=args.overwrite,
        up=args.up,
        meters_per_unit=args.scale,
        unknown={
            "board": args.board,
            "moving": tuple(args.moving),
            "shared_lens": args.shared_lens,
            "lenses": args.lenses,
            "distance": _distance(args.distance),
        },
        masks=args.masks,
        model=args.model,
        words=args.words,
    )


def run_prepare(
    source: Path,
    out: Path,
    *,
    window: dict[str, Any] | None = None,
    hold_out: dict[str, Any] | None = None,
    unknown: dict[str, Any] | None = None,
    masks: str = "none",
    model: Path | None = None,
    words: str | None = None,
    progress_kind: str = "none",
    **fields: Any,
) -> Plan:
    """Make a data set and check it.

    Args:
        source: Folder of videos or frames, or one video.
        out: Folder of the data set.
        window: Fields of `prepare.frame_choice.Window`.
        hold_out: Fields of `prepare.data_splits.HoldOut`.
        unknown: Fields of `prepare.unknown_cameras.UnknownCameras`.
        masks: Folder of masks of the frames, "features", "sam2", "sam3" or "none".
        model: Folder of the weights; for SAM2, that of the user's settings if None.
        words: Phrases that SAM3 searches for, separated by commas.
        progress_kind: Form of progress output (`progress.make`).
        **fields: Further fields of `prepare.plan.Request`.

    Raises:
        ConfigError, DatasetError, BackendError: An input cannot be used.
        Interrupted: Ctrl-C; finished images are kept.
    """
    window = window or {}
    _check(window, source, fields.get("calibration"))
    _check_masks(masks, model, words)
    from ...prepare import data_splits, frame_choice, plan, prepare, unknown_cameras
    from ...progress import make

    request = plan.Request(
        source,
        out,
        window=frame_choice.Window(**window),
        hold_out=data_splits.HoldOut(**(hold_out or {})),
        unknown=unknown_cameras.UnknownCameras(**(unknown or {})),
        masks=None if masks in _NO_FOLDER else Path(masks),
        **fields,
    )
    with make(progress_kind) as progress:
        try:
            made = prepare.prepare(request, progress)
        except KeyboardInterrupt as stop:
            raise errors.Interrupted(
                f"stopped; finished images are kept in {out}, run the same command again to continue"
            ) from stop
        if progress_kind == "json":
            progress({"event": "prepared", "path": str(out)})
    if progress_kind == "auto":
        terminal.print_lines(summary(made))
    _complete(made, masks, {"model": model, "words": words}, progress_kind)
    return made


def _check(window: dict[str, Any], source: Path, calibration: Path | None) -> None:
    """Raise UsageError for a window that ends before it starts, or DatasetError for a missing path."""
    if window.get("end") is not None and window["end"] <= window.get("start", 0.0):
        raise errors.UsageError(f"--end {window['end']:g}: expected a time after --start {window.get('start', 0.0):g}")
    input_paths.check_source(Path(source))
    if calibration is not None:
        input_paths.check_calibration(Path(calibration))


def _check_masks(masks: str, model: Path | None, words: str | None) -> None:
    """Check the options of masks before the images are written.

    Raises:
        UsageError: An option is missing, or the choice of masks does not use it.
        ConfigError: The folder of the weights does not exist.
        BackendError: OpenCV is missing.
    """
    if words is not None and masks != "sam3":
        raise errors.UsageError(f"--words {words}: applies to --masks sam3, found --masks {masks}")
    if model is not None and masks not in ("sam2", "sam3"):
        raise errors.UsageError(f"--model {model}: applies to --masks sam2 and sam3, found --masks {masks}")
    if masks in ("sam2", "sam3"):
        from . import masks as masks_command

        try:
            checked = masks_command.checked(masks_command.Options(masks, model, words))
        except errors.UsageError as error:
            raise errors.UsageError(str(error).replace("--backend", "--masks")) from error
        if checked.model is not None and not checked.model.is_dir():
            raise errors.ConfigError(f"--model {checked.model}: expected a folder of weights, found none")
    if masks == "features":
        from ...masks import feature_points

        feature_points.require()


def _complete(plan: Plan, masks: str, given: dict[str, Any], progress_kind: str) -> None:
    """Write the masks, check the capture, and print the next command.

    The capture is also checked if image features show no object.
    """
    try:
        _make_masks(plan, masks, given, progress_kind)
    except errors.DatasetError as error:
        if masks != "features":
            raise
        _check_capture(plan, progress_kind)
        reason = str(error).replace("--backend", "--masks")  # the option of this command
        raise errors.DatasetError(f"{reason}. The data set without masks is complete") from error
    _check_capture(plan, progress_kind)
    if progress_kind == "auto":
        next_command = f"r5dgs train {shlex.quote(str(plan.request.out))} --out RUN --scene SCENE.r5dgs"
        terminal.print_lines([f"written: {plan.request.out}. Next: {next_command}"])


def _make_masks(plan: Plan, masks: str, given: dict[str, Any], progress_kind: str) -> None:
    """Write the masks of the images."""
    from . import masks as masks_command

    if masks == "none":
        return
    if masks in masks_command.MAKERS:
        overwrite = plan.request.overwrite
        masks_command.run_masks(
            plan.request.out, backend=masks, overwrite=overwrite, progress_kind=progress_kind, **given
        )
        return
    from ...prepare import source_masks
    from ...progress import make

    with make(progress_kind) as progress:
        made = source_masks.write(Path(masks), plan, progress)
    if progress_kind == "auto":
        terminal.print_lines([f"{made.images} masks, {made.objects} objects"])


def _check_capture(plan: Plan, progress_kind: str) -> None:
    """Check the data set, add the findings to its record, and print them.

    Raises:
        DatasetError: The data set has errors.
    """
    from ...check import check
    from ...prepare import capture_file
    from ...progress import make

    out = Path(plan.request.out)
    found = [one for one in check(out) if one.code not in NOT_RECORDED]
    capture = capture_file.read(out)
    assert capture is not None
    rows = [dataclasses.asdict(one) for one in found]
    # Places are relative, so that equal commands write equal files into any folder.
    rows = [{k: v.replace(f"{out}/", "").replace(str(out), ".") for k, v in row.items()} for row in rows]
    capture_file.write(out, {**capture, "checks": rows})
    if progress_kind == "auto":
        terminal.print_lines(map(str, found))
    if progress_kind == "json":
        with make(progress_kind) as progress:
            progress({"event": "checked", "findings": rows})
    if wrong := [one for one in found if one.severity == findings.ERROR]:
        raise errors.DatasetError(f"{out}: the data set cannot be trained: {wrong[0]}")


def summary(plan: Plan) -> list[str]:
    """Return the lines that describe a prepared data set."""
    lines = []
    for number, camera in enumerate(plan.cameras):
        source, offset = camera.source, plan.offsets[number]
        clock = ""
        if offset.sigma is not None and len(plan.cameras) > 1:
            clock = f", clock {1e3 * offset.seconds:+.1f} ms"
            clock += f" (± {1e3 * offset.sigma:.1f} ms, from {offset.method})" if offset.sigma else ""
        used = len(plan.choice.indices[number]) - len(plan.lost.get(source.name, []))
        lines.append(
            f"{source.name}: {used} of {len(source.times)} frames, "
            f"{source.width}x{source.height} at {1 / source.interval:.4g} per second{clock}"
        )
        lines += [f"  {note}" for note in source.notes]
    lines += list(plan.notes)
    size, timeline = plan.size, plan.timeline
    shown = plan.rectifier(0, int(plan.choice.indices[0][0]))
    lines.append(
        f"images of {shown.width}x{shown.height}: training needs about {size.training_bytes / 2**30:.1f} GB of the "
        f"{size.machine_bytes / 2**30:.1f} GB of this machine"
    )
    seconds = timeline.t_max * timeline.seconds_per_unit
    lines.append(f"{seconds:.2f} s are observed; t_max is {timeline.t_max:.3g}")
    return lines


def _offsets(given: Sequence[str]) -> dict[str, float]:
    """Convert arguments CAMERA=MS to seconds by camera."""
    found: dict[str, float] = {}
    for text in given:
        name, mark, value = text.rpartition("=")
        if name in found:
            raise errors.UsageError(f"--offset {text}: expected one offset of {name}, found another one")
        try:
            found[name] = float(value) / 1e3
        except ValueError:
            mark = ""
        if not mark or not name or not math.isfinite(found[name]):
            raise errors.UsageError(f"--offset {text}: expected a camera and milliseconds, such as cam0=12.5")
    return found


def _distance(given: Sequence[str] | None) -> tuple[str, str, float] | None:
    """Convert the arguments of --distance."""
    if given is None:
        return None
    first, second, text = given
    try:
        meters = float(text)
    except ValueError:
        meters = math.nan
    if not (0 < meters < math.inf):
        raise errors.UsageError(f"--distance: expected metres, more than 0, after two cameras, found {text!r}")
    if first == second:
        raise errors.UsageError(f"--distance: expected two cameras, found {first!r} twice")
    return first, second, meters

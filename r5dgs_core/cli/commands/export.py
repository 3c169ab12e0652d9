"""The command ``r5dgs export``: write a scene file in a format of other programs."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ... import errors, folder_lock, input_paths
from ...formats import registry
from .. import options

if TYPE_CHECKING:
    from ...scene.scene import Scene


NAME = "export"
SHORT = "write a scene in a format of other programs"
LONG = "Write a scene at a time, or for a range of frames, in a format of other programs."
EXAMPLE = "scene.r5dgs --to ply --out frame.ply --frames 1:60"
PAGE = "user/export.md"

STILL_SIDE = 480  # longest side of the picture in formats with one, pixels
MOST_FRAMES = 1_000_000
FARTHEST = 1e9  # scene times
_ROUNDING = 1e-6  # of frame numbers
log = logging.getLogger(__name__)


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    p.add_argument(
        "--to", required=True, metavar="FORMAT", help=f"format of the file, one of {', '.join(registry.MODULES)}"
    )
    out = "file to write; with --frames, formats with one file per frame insert the frame number into the name"
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help=out)
    when = p.add_mutually_exclusive_group()
    time = "scene time (default: t_max), may exceed t_max; formats with poses take several, such as 0,0.5,1.2"
    when.add_argument("--time", type=times, metavar="T", help=time)
    frames = "range of Blender frames, both included; frame 1 is scene time 0"
    when.add_argument("--frames", type=frame_range, metavar="A:B", help=frames)
    until = (
        "last scene time in files with motion (default: a third of the observed span after t_max, or scene time 1 if "
        "later)"
    )
    when.add_argument("--until", type=float, metavar="T", help=until)
    p.add_argument("--objects", metavar="WORDS", help="objects to export: 'red mug', 'all except the background'")
    plain = "leave out object ids and identity encodings of ply, for programs that refuse unknown columns"
    p.add_argument("--plain", action="store_true", help=plain)
    p.add_argument("--overwrite", action="store_true", help="replace existing files")
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"times": args.time, "frames": args.frames, "until": args.until, "words": args.objects, "plain": args.plain}
    run_export(args.file, args.to, args.out, **given, overwrite=args.overwrite, progress_kind=args.progress)


@folder_lock.writes("out")
def run_export(
    path: Path,
    to: str,
    out: Path,
    *,
    times: tuple[float, ...] | None = None,
    frames: tuple[int, int] | None = None,
    until: float | None = None,
    words: str | None = None,
    plain: bool = False,
    overwrite: bool = False,
    progress_kind: str = "none",
) -> list[Path]:
    """Write a scene file in another format.

    Args:
        path: The scene file.
        to: Name of the format, a key of `formats.registry.MODULES`.
        out: File to write; the frame number is inserted if each frame is a file of its own.
        times: Scene times, one unless the format has several; if neither ``times`` nor ``frames`` is given, t_max, or
            for a format with several the frames up to the end of the prediction.
        frames: First and last Blender frame; frame 1 is scene time 0.
        until: Last scene time of formats with motion (see `formats.registry.Options`).
        words: Objects to export, as in ``r5dgs query``; all if None.
        plain: True to leave out columns of our own; see `formats.registry.Options`.
        overwrite: True to replace existing files.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The files written.

    Raises:
        UsageError: The format is unknown, or another argument does not suit it.
        ConfigError: A file exists, no object matches the words, or a time is before the first observed one.
        BackendError: The format needs a package that is not installed.
    """
    if to not in registry.MODULES:
        raise errors.UsageError(f"--to {to}: expected one of {', '.join(registry.MODULES)}")
    input_paths.check_output("--out", out)
    input_paths.check_scene(path)
    chosen = registry.usable(to)  # imports numpy
    _check_arguments(chosen, out, words, plain, times=times, frames=frames, until=until)
    from ...scene import scene_file

    scene = scene_file.read(path)
    what = selection(chosen, scene, times=times, frames=frames, until=until, words=words)
    what = dataclasses.replace(what, plain=plain)
    targets = chosen.paths(out, what, scene)
    present = [target for target in targets if target.exists()]
    if present and not overwrite:
        raise errors.ConfigError(f"{present[0]}: the file exists; replace it with --overwrite, or choose another name")
    lost = chosen.losses(scene, what)
    written = _write(chosen, scene, out, what, len(targets), progress_kind, lost)
    if progress_kind != "json":
        print(f"written: {written[0]}" + (f" to {written[-1].name}" if len(written) > 1 else ""))
        print(f"not kept: {chosen.loses}")
        for sentence in lost:
            print(f"lost here: {sentence}")
    return written


def _write(
    chosen: registry.Format,
    scene: Scene,
    out: Path,
    what: registry.Options,
    total: int,
    progress_kind: str,
    lost: list[str],
) -> list[Path]:
    """Write a number of files of a format with progress output and return their paths."""
    from ...progress import make

    written = []
    with make(progress_kind) as progress:
        for target in chosen.write(scene, out, what):
            written.append(target)
            progress({"event": "export", "done": len(written), "total": total, "unit": "files"})
        if progress_kind == "json":
            told = {"not_kept": chosen.loses, "lost": lost}
            progress({"event": "written", "paths": [str(target) for target in written], **told})
    return written


def _check_arguments(
    chosen: registry.Format,
    out: Path,
    words: str | None,
    plain: bool,
    *,
    times: tuple[float, ...] | None,
    frames: tuple[int, int] | None,
    until: float | None,
) -> None:
    """Raise UsageError if arguments of `run_export` do not suit the format."""
    if out.suffix.lower() != chosen.suffix:
        raise errors.UsageError(f"--out {out}: expected a name that ends in {chosen.suffix}")
    if words is not None and not chosen.has_objects:
        raise errors.UsageError(f"--objects: files of format {chosen.name} hold no objects; leave it out")
    if plain and not chosen.has_columns:
        raise errors.UsageError(f"--plain: files of format {chosen.name} have no columns of R5DGS; leave it out")
    if chosen.has_motion and not (times is None and frames is None):
        option = "--frames" if times is None else "--time"
        raise errors.UsageError(f"{option}: files of format {chosen.name} hold the motion; give its end with --until")
    if chosen.whole and not (times is None and frames is None and until is None):
        option = "--until" if until is not None else "--frames" if times is None else "--time"
        raise errors.UsageError(f"{option}: files of format {chosen.name} hold all times; leave it out")
    if until is not None and not chosen.has_motion:
        raise errors.UsageError(f"--until: files of format {chosen.name} hold no motion; leave it out")
    if frames is not None and frames[1] - frames[0] >= MOST_FRAMES:
        raise errors.UsageError(f"--frames: expected at most {MOST_FRAMES} frames, got {frames[0]}:{frames[1]}")
    if times is not None and len(times) > 1 and not chosen.has_times:
        raise errors.UsageError(f"--time: files of format {chosen.name} hold one time; give one, or --frames")
    for option, values in (("--time", times or ()), ("--until", () if until is None else (until,))):
        if not all(math.isfinite(value) and abs(value) <= FARTHEST for value in values):
            raise errors.UsageError(f"{option}: expected finite numbers up to {FARTHEST:g}")


def selection(
    chosen: registry.Format,
    scene: Scene,
    *,
    times: tuple[float, ...] | None = None,
    frames: tuple[int, int] | None = None,
    until: float | None = None,
    words: str | None = None,
) -> registry.Options:
    """Return the selected part of the scene (times and objects), with a picture if the format has one.

    Raises:
        UsageError: ``until`` is not finite or before t_max, or the words are empty.
        ConfigError: No object matches the words, or a time is before the first observed one.
    """
    if until is not None and not (math.isfinite(until) and until >= scene.t_max):
        raise errors.UsageError(f"--until {until:g}: expected a time from t_max on, which is {scene.t_max:g}")
    if frames is None and times is None and chosen.has_times:
        frames = default_frames(scene)
    numbers = None if frames is None else tuple(range(frames[0], frames[1] + 1))
    if numbers is not None:
        times = tuple((number - 1) / scene.frames_per_unit for number in numbers)
    first = float(scene.tracks.times[0])
    if times is not None and min(times) < first - _ROUNDING / scene.frames_per_unit:
        option = "--time" if frames is None else "--frames"
        expected = f"expected scene times from the first observed one, {first:g}, on"
        raise errors.ConfigError(f"{option}: {expected}, got {min(times):g}")
    ids = None if words is None else object_ids(scene, words)
    return registry.Options(
        times or (scene.t_max,), numbers, ids, until, _still(scene, ids) if chosen.has_still else None
    )


def _still(scene: Scene, object_ids: frozenset[int] | None) -> bytes | None:
    """Return a PNG of the scene, or of some of its objects, at t_max; None if no rasterizer is usable."""
    from ...data import images
    from ...formats import image_files
    from ...playback.scene_player import Player
    from ...render import highlight, scene_renderer, viewpoints
    from ...scene import cameras

    camera = cameras.resized(scene.cameras[0] if scene.cameras else viewpoints.overview(scene), STILL_SIDE)
    frame = Player(scene).frame(scene.t_max, origin=camera.center)
    if object_ids is not None:
        frame = highlight.without_others(frame, object_ids)
    try:
        color = scene_renderer.render_frame(scene, frame, camera).color
    except errors.BackendError as error:
        log.warning("the page has no picture for browsers without WebGL: %s", error)
        return None
    return image_files.png(images.to_uint8(color))


def default_frames(scene: Scene) -> tuple[int, int]:
    """Return the frames from the first observed time to the end of the prediction that Blender shows."""
    from ...scene import predictability

    first, last = (scene.frames_per_unit * t + 1 for t in (scene.tracks.times[0], predictability.horizon(scene)))
    return math.ceil(first - _ROUNDING), math.floor(last + _ROUNDING)


def times(text: str) -> tuple[float, ...]:
    """Convert an argument T or T,T,... to numbers."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number, or several such as 0,0.5,1.2, got {text!r}") from None


def frame_range(text: str) -> tuple[int, int]:
    """Convert an argument A:B to two integers, A <= B."""
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        first, last = 1, 0
    if first > last:
        raise argparse.ArgumentTypeError(f"expected first and last frame, such as 1:60, got {text!r}")
    return first, last


def object_ids(scene: Scene, words: str, option: str = "--objects") -> frozenset[int]:
    """Return the ids of the objects that the words name or describe, without an encoder.

    Raises:
        UsageError: The words are empty or incomplete.
        ConfigError: Nothing matches one of the phrases.
    """
    from ...language import query
    from ...search import object_search

    if not object_search.phrases_of(words):
        raise errors.UsageError(f"{option} {words!r}: expected words for objects, such as 'red mug'")
    try:
        found = object_search.search(scene, words)
    except errors.ConfigError as error:
        raise type(error)(f"{option}: {error}") from error
    missing = query.unanswered(scene, words) if found else [words]
    if missing:
        labels = [label for label in object_search.labels_of(scene) if label.object_id > 0]
        raise errors.ConfigError(f"{option} {words!r}: {object_search.explain_nothing(labels, missing[0])}")
    return frozenset(match.object_id for match in found)

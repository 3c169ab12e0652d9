"""The command ``r5dgs render``: write a video or pictures of a scene."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from ... import folder_lock, input_paths
from ...film import settings as film_settings
from ...film.settings import Settings
from ...playback import modes
from .. import inputs, options
from .export import frame_range

if TYPE_CHECKING:
    from ...film.film import Result

NAME = "render"
SHORT = "write a video or pictures of a scene"
LONG = "Render a scene along a camera path and over a range of times, past t_max too, to a video, a picture or frames."
EXAMPLE = "scene.r5dgs --out film.mp4 --camera orbit --size 1920x1080"
PAGE = "user/film.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    out = ".mp4 (H.264), .mov (ProRes 4444), .webm (VP9), .png, .exr, or a folder of frames"
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help=out)
    _add_content(p)
    _add_picture(p)
    _add_output(p)
    options.add_threads(p)
    options.add_progress(p)


def _add_content(p: argparse.ArgumentParser) -> None:
    camera = (
        "name or number of a captured camera, 'orbit', or a camera path of nerfstudio (.json); several captured "
        "cameras for a curve through them (default: the first captured camera); write SCENE before this option"
    )
    p.add_argument("--camera", nargs="+", default=[], metavar="CAMERA", help=camera)
    when = (
        "scene time, or first and last one; may exceed t_max (default: up to a third of the observed span after it, or "
        "scene time 1 if later; a picture shows t_max)"
    )
    p.add_argument("--time", type=time_range, metavar="T[:T]", help=when)
    p.add_argument("--seconds", type=options.positive, metavar="S", help="length of the film (default: real time)")
    p.add_argument("--fps", type=options.positive, metavar="N", help="frames per second (default: 24)")
    mode = f"playback mode past t_max, one of {', '.join(modes.every())} (default: rigid)"
    p.add_argument("--mode", default="rigid", metavar="MODE", help=mode)
    p.add_argument("--objects", metavar="WORDS", help="objects to show: 'red mug', 'all except the background'")
    p.add_argument("--hide", metavar="WORDS", help="objects to leave out, with their shadows")


def _add_picture(p: argparse.ArgumentParser) -> None:
    size = "width and height, or pixels along the longer side (default: those of the camera)"
    p.add_argument("--size", type=picture_size, metavar="WxH", help=size)
    samples = "supersampling: draw N x N samples per pixel (default: 1)"
    p.add_argument("--samples", type=options.at_least(1), default=1, metavar="N", help=samples)
    p.add_argument("--transparent", action="store_true", help="alpha instead of the sky")
    p.add_argument(
        "--beside", type=Path, metavar="DATA", help="data set whose images of the camera are shown on the left"
    )
    p.add_argument("--marker", action="store_true", help="mark observed and predicted time")
    passes = f"further layers of EXR pictures, separated by commas: {', '.join(film_settings.PASSES)}"
    p.add_argument("--passes", type=pass_names, default=(), metavar="NAMES", help=passes)


def _add_output(p: argparse.ArgumentParser) -> None:
    p.add_argument("--frames", type=frame_range, metavar="A:B", help="frames to write to a folder, both included")
    p.add_argument("--share", action="store_true", help="draw missing frames together with other processes")
    p.add_argument("--overwrite", action="store_true", help="replace existing files")


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    names = ("out", "time", "seconds", "fps", "size", "samples", "mode", "transparent", "marker", "passes", "frames")
    given = {name: getattr(args, name) for name in (*names, "share", "overwrite")}
    settings = Settings(camera=tuple(args.camera), **given)
    chosen = {"words": args.objects, "hide": args.hide, "beside": args.beside}
    run_render(args.file, settings, **chosen, threads=args.threads, progress_kind=args.progress)


def run_render(
    path: Path,
    settings: Settings,
    *,
    words: str | None = None,
    hide: str | None = None,
    beside: Path | None = None,
    threads: int | None = None,
    progress_kind: str = "none",
) -> Result:
    """Render a scene file to a video, a picture or frames.

    Args:
        path: The scene file.
        settings: What to write, and where.
        words: Objects to show, as in ``r5dgs query``; all if None.
        hide: Objects to leave out with their shadows; none if None.
        beside: Data set whose images are shown on the left of the picture, or None.
        threads: Threads of the rasterizer; None for all cores.
        progress_kind: Form of progress output (`progress.make`).

    Raises:
        UsageError: Settings contradict each other.
        ConfigError: Nothing matches the words, no Gaussians are left, a camera does not exist, times are outside, or
            a file exists or cannot be written.
        BackendError: A package or an encoder is missing.
    """
    film_settings.check(settings, beside)
    inputs.check_mode(settings.mode)
    if not settings.is_folder:
        input_paths.check_output("--out", settings.out)
    input_paths.check_scene(path)
    if beside is not None:
        inputs.check_dataset(beside)
    options.use_threads(threads)
    with folder_lock.hold_run_around(settings.out.parent):
        return _render(path, settings, words, hide, beside, progress_kind)


def _render(
    path: Path, settings: Settings, words: str | None, hide: str | None, beside: Path | None, progress_kind: str
) -> Result:
    from ...data import dataset as datasets
    from ...film import film
    from ...progress import make
    from ...scene import scene_file
    from . import export

    scene = scene_file.read(path)
    inputs.check_mode(settings.mode, scene, path)
    shown = None if words is None else export.object_ids(scene, words)
    hidden = None if hide is None else export.object_ids(scene, hide, "--hide")
    dataset = None
    if beside is not None:
        dataset = datasets.read(beside, min_registered=0.0).relative_to(scene.origin)
    with make(progress_kind) as progress:
        chosen = {"shown": shown, "hidden": hidden, "dataset": dataset}
        result = film.write(scene, settings, file=path, **chosen, progress=progress)
        if progress_kind == "json":
            progress({"event": "written", "paths": [str(path) for path in result.paths]})
    if progress_kind != "json":
        print(_summary(settings, result))
    return result


def _summary(settings: Settings, result: Result) -> str:
    if not settings.is_folder:
        return f"written: {settings.out}"
    others = f"; {result.others} were there or drawn by other processes" if result.others else ""
    return f"written: {len(result.paths)} frames in {settings.out}{others}"


def time_range(text: str) -> tuple[float, float]:
    """Convert an argument T or A:B to two scene times."""
    try:
        start, _, end = text.partition(":")
        found = float(start), float(end or start)
    except ValueError:
        found = math.nan, math.nan
    if not all(map(math.isfinite, found)) or found[0] > found[1]:
        raise argparse.ArgumentTypeError(f"expected a scene time, or first and last one such as 0:1.2, got {text!r}")
    return found


def picture_size(text: str) -> tuple[int, int]:
    """Convert an argument WxH or N to width and height, or to 0 and the longer side."""
    found = re.fullmatch(r"(?:(0*[1-9]\d{0,4})x)?(0*[1-9]\d{0,4})", text.strip())
    if found is None:
        raise argparse.ArgumentTypeError(f"expected width and height such as 1920x1080, or pixels, got {text!r}")
    return int(found[1] or 0), int(found[2])


def pass_names(text: str) -> tuple[str, ...]:
    """Convert an argument to names of layers."""
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    unknown = [name for name in names if name not in film_settings.PASSES]
    if unknown or not names:
        raise argparse.ArgumentTypeError(f"expected some of {', '.join(film_settings.PASSES)}, got {text!r}")
    return names

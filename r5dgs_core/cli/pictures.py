"""Pictures of objects: their options, the checks of these, and drawing."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import errors, input_paths
from ..playback import modes
from . import inputs, options

if TYPE_CHECKING:
    from ..render.viewpoints import Viewpoint
    from ..scene.scene import Scene

SIZES = (16, 8192)  # smallest and largest picture, pixels along the longer side


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the options of a picture of the scene."""
    p.add_argument("--camera", metavar="N", help="name or number of the camera (default: the best view)")
    p.add_argument("--time", type=float, metavar="T", help="scene time of the picture; may exceed t_max")
    kinds = f"playback mode, one of {', '.join(modes.every())} (default: rigid)"
    p.add_argument("--mode", default="rigid", metavar="MODE", help=kinds)
    p.add_argument("--size", type=int, metavar="PIXELS", help="pixels along the longer side of the picture")
    options.add_threads(p)


def values_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options, by the names of the arguments of `draw`, with ``threads``."""
    return {"camera": args.camera, "t": args.time, "mode": args.mode, "size": args.size, "threads": args.threads}


def check(
    option: str, path: Path | None, camera: str | None = None, t: float | None = None, size: int | None = None
) -> None:
    """Raise UsageError or ConfigError if no picture can be written with these options, before any work."""
    if path is None:
        given = {"--camera": camera, "--time": t, "--size": size}
        lone = next((name for name, value in given.items() if value is not None), None)
        if lone is not None:
            raise errors.UsageError(f"{lone}: requires a picture; add {option} FILE.png")
        return
    if path.suffix.lower() != ".png":
        raise errors.UsageError(f"{option} {path}: expected a name that ends in .png")
    input_paths.check_output(option, path)
    if size is not None and not SIZES[0] <= size <= SIZES[1]:
        raise errors.UsageError(f"--size {size}: expected {SIZES[0]} to {SIZES[1]} pixels")


def draw(
    scene: Scene,
    object_ids: Collection[int],
    out: Path,
    *,
    camera: str | None = None,
    t: float | None = None,
    mode: str = "rigid",
    size: int | None = None,
    context: bool = False,
) -> Viewpoint:
    """Write a picture of some objects.

    Args:
        scene: The scene.
        object_ids: Ids of the objects, at least one.
        out: PNG file.
        camera: Name or number of the camera; the camera that shows the objects best if None.
        t: Scene time, may exceed t_max; if None, the best of the first, middle and last observed time.
        mode: Playback mode past t_max.
        size: Pixels along the longer side; those of the camera if None.
        context: Show the rest of the scene dimmed instead of a transparent background.

    Returns:
        Camera and time of the picture.

    Raises:
        ConfigError: The camera or mode does not exist, or the objects have no Gaussians.
    """
    from ..data import images
    from ..render import highlight
    from ..scene import cameras

    check("--render", out, camera, t, size)
    inputs.check_mode(mode, scene, scene.name)
    empty = [item.name for item in scene.objects if item.id in object_ids and item.count == 0]
    if empty and len(empty) == len(object_ids):
        raise errors.ConfigError(f"--render {out}: {', '.join(empty)}: no Gaussians, so there is nothing to draw")
    viewpoint = best_viewpoint(scene, object_ids, camera, t, mode)
    view = viewpoint.camera if size is None else cameras.resized(viewpoint.camera, size)
    drawn = highlight.highlight if context else highlight.isolate
    images.write_png(out, drawn(scene, object_ids, view, viewpoint.t, mode))
    return viewpoint


def best_viewpoint(
    scene: Scene, object_ids: Collection[int], camera: str | None, t: float | None, mode: str
) -> Viewpoint:
    """Return the camera and the time that show the objects best; a given camera or time is kept."""
    from ..render import viewpoints

    return viewpoints.best(scene, viewpoints.candidates(scene, camera, t), object_ids, mode)

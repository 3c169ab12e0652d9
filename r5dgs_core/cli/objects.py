"""The commands ``r5dgs objects`` and ``r5dgs query --render``: tables and pictures of objects."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import errors, input_paths, terminal
from . import language, runs

if TYPE_CHECKING:
    from ..render.viewpoints import Standpoint
    from ..scene.scene import Scene
    from ..search.object_search import Match

SIZES = (16, 8192)  # smallest and largest picture, pixels along the longer side


def run_objects(
    target: Path,
    data: Path | None = None,
    *,
    legend: Path | None = None,
    camera: str | None = None,
    t: float | None = None,
    mode: str = "rigid",
    size: int | None = None,
    threads: int | None = None,
    as_json: bool = False,
) -> dict[str, Any]:
    """Print the table of a scene's objects, and optionally draw a picture labelled with them.

    Args:
        target: Run folder or ``.r5dgs`` file.
        data: Data set whose views are used to count pixels and whose masks are compared; that of the run if None.
        legend: PNG file of the picture, or None.
        camera: Name or number of the picture's camera; the one that sees most objects if None.
        t: Scene time of the picture; if None, the best of the first, middle and last observed time.
        mode: Playback mode past t_max.
        size: Pixels of the picture along its longer side.
        threads: Threads of the kernels; see `runs.use_threads`.
        as_json: Print JSON instead of the table.

    Returns:
        The content printed by ``--json`` (`evaluation.object_table.to_json`).
    """
    check_picture("--legend", legend, camera, t, size)
    runs.check_mode(mode)
    runs.check_target(target, data)
    from ..evaluation import object_table
    from ..render import viewpoints

    runs.use_threads(threads)
    scene, dataset = runs.open_target(target, data)
    runs.check_mode(mode, scene, target)
    standpoint = (
        None if legend is None else _standpoint(scene, [o.id for o in scene.objects if o.id > 0], camera, t, mode)
    )
    if dataset is None:
        views: list[Any] = object_table.own_views(scene)
    else:
        views = viewpoints.spread((*dataset.val, *dataset.test) or dataset.train, object_table.MOST_VIEWS)
    rows = object_table.measure(scene, views, mode)
    result = object_table.to_json(scene, rows, len(views))
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        terminal.console().print(object_table.table(scene, rows, len(views)))
    if legend is not None and standpoint is not None:
        from ..data import images
        from ..evaluation import legend as legends

        images.write_png(legend, legends.draw(scene, standpoint, mode, longest=size))
        if not as_json:
            print(f"written: {legend} (camera {standpoint.camera.name}, t = {standpoint.t:g})")
    return result


def run_query(
    path: Path,
    text: str,
    options: dict[str, Any],
    *,
    render: Path | None = None,
    context: bool = False,
    threads: int | None = None,
    **picture: Any,
) -> list[Match]:
    """Find the objects of a scene file that a text describes, print them and optionally draw them.

    Args:
        path: The scene file.
        text: One or more things to find.
        options: Further arguments of `language.run_query`.
        render: PNG file of the picture, or None.
        context: Show the rest of the scene dimmed.
        threads: Threads of the kernels; see `runs.use_threads`.
        **picture: ``camera``, ``t``, ``mode`` and ``size`` of `render_objects`.

    Returns:
        The matches, best first. No picture is drawn if there are none.
    """
    if render is None and context:
        raise errors.UsageError("--context: requires a picture; add --render FILE.png")
    check_picture("--render", render, picture.get("camera"), picture.get("t"), picture.get("size"))
    runs.check_mode(picture.get("mode", "rigid"))
    scene, found = language.run_query(path, text, **options)
    if render is None or not found:
        return found
    runs.use_threads(threads)
    standpoint = render_objects(scene, [match.object_id for match in found], render, context=context, **picture)
    if not options.get("as_json"):
        print(f"written: {render} (camera {standpoint.camera.name}, t = {standpoint.t:g})")
    return found


def render_objects(
    scene: Scene,
    object_ids: Collection[int],
    out: Path,
    *,
    camera: str | None = None,
    t: float | None = None,
    mode: str = "rigid",
    size: int | None = None,
    context: bool = False,
) -> Standpoint:
    """Write a picture of some objects.

    Args:
        scene: The scene.
        object_ids: Ids of the objects, at least one.
        out: PNG file.
        camera: Name or number of the camera; the one that sees the objects best if None.
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
    from ..render import highlight, viewpoints

    check_picture("--render", out, camera, t, size)
    runs.check_mode(mode, scene, scene.name)
    empty = [item.name for item in scene.objects if item.id in object_ids and item.count == 0]
    if empty and len(empty) == len(object_ids):
        raise errors.ConfigError(f"--render {out}: {', '.join(empty)}: no Gaussians, so there is nothing to draw")
    standpoint = _standpoint(scene, object_ids, camera, t, mode)
    view = standpoint.camera if size is None else viewpoints.sized(standpoint.camera, size)
    draw = highlight.highlight if context else highlight.isolate
    images.write_png(out, draw(scene, object_ids, view, standpoint.t, mode))
    return standpoint


def check_picture(
    option: str, path: Path | None, camera: str | None = None, t: float | None = None, size: int | None = None
) -> None:
    """Raise UsageError or ConfigError for options that no picture can be written with, before any work."""
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


def _standpoint(
    scene: Scene, object_ids: Collection[int], camera: str | None, t: float | None, mode: str
) -> Standpoint:
    from ..render import viewpoints

    return viewpoints.best(scene, viewpoints.candidates(scene, camera, t), object_ids, mode)

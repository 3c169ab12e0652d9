"""What ``r5dgs objects`` and ``r5dgs query --render`` do: which id is what, and pictures of some objects."""

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

SIZES = (16, 8192)  # of pictures, pixels along the longer side


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
    """Print the table of a scene's objects, and draw a picture that names them.

    Args:
        target: A run folder, or a `.r5dgs` file.
        data: The data set: pixels are counted in its views and compared with its masks. By default a run's own.
        legend: PNG file of the picture, or None.
        camera: Name or number of the picture's camera; the one that sees most objects where None.
        t: Scene time of the picture; of first, middle and last observed time the one with most to see where None.
        mode: Way to move past t_max.
        size: Pixels of the picture along its longer side.
        threads: Threads of the kernels; see `runs.use_threads`.
        as_json: Print JSON instead of the table.

    Returns:
        What ``--json`` prints (`evaluation.object_table.to_json`).
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
    """Say which objects of a scene file a text names or means, and draw them.

    Args:
        path: The scene file.
        text: One or several things.
        options: What else `language.run_query` takes.
        render: PNG file of the picture, or None.
        context: Show the rest of the scene in it, dimmed.
        threads: Threads of the kernels; see `runs.use_threads`.
        **picture: ``camera``, ``t``, ``mode`` and ``size`` of `render_objects`.

    Returns:
        The matches, best first; where there are none, no picture is made.
    """
    if render is None and context:
        raise errors.UsageError("--context: is for the picture; name it, too: --render FILE.png")
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
        object_ids: The objects, at least one.
        out: PNG file.
        camera: Name or number of the camera; the one that sees them best where None.
        t: Scene time, past t_max too; the best of first, middle and last observed time where None.
        mode: Way to move past t_max.
        size: Pixels along the longer side, the camera's own where None.
        context: Show the rest of the scene, dimmed; else the objects alone, on transparency.

    Returns:
        Where the picture was taken from, and when.

    Raises:
        ConfigError: There is no such camera or mode, or nothing that could be drawn.
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
    """Refuse what no picture can be written for, before any work. Raises ConfigError."""
    if path is None:
        given = {"--camera": camera, "--time": t, "--size": size}
        lone = next((name for name, value in given.items() if value is not None), None)
        if lone is not None:
            raise errors.UsageError(f"{lone}: is for the picture; name it, too: {option} FILE.png")
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

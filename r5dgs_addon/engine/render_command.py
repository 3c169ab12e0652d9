"""``blender FILE.blend --command r5dgs_render``: frames of an animation for render farms.

Any number of processes may render the same frames. Compared with ``blender -a``: no frame is lost or rendered twice if
a process is killed, files are complete from the moment they have their names, and every failure has an exit status
other than 0. Blender itself ends a command with status 1 if the extension that registers it is not enabled.
"""

import argparse
import os
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from ...r5dgs_core import errors, shared_frames
from ..ui import plural
from . import engine

NAME = "r5dgs_render"
FAILED = 1  # exit status, as of Blender's own failures
SEPARATORS = r"[/\\]"

_handle = None


def run(arguments: Sequence[str]) -> int:
    """Render the missing frames of the current scene. Returns the exit status; argparse exits with 2."""
    parser = argparse.ArgumentParser(
        prog=f"blender FILE.blend [-o OUTPUT] [-F FORMAT] [-s FIRST] [-e LAST] --command {NAME}",
        description="Render the missing frames of an animation with the R5DGS engine. Any number of processes may "
        "render the same frames; each ends when all its frames exist.",
    )
    parser.add_argument(
        "--frames", type=parse_frames, metavar="LIST", help="such as 1..50,60; by default the frame range of the scene"
    )
    scene = bpy.context.scene
    try:
        rendered, existing = render(scene, parser.parse_args(arguments).frames or _range_of(scene))
    except errors.R5dgsError as error:
        print(f"{NAME}: {error}", file=sys.stderr, flush=True)
        return FAILED
    print(f"{NAME}: {plural.of(rendered, 'frame')} rendered, {existing} existed or were rendered by other processes")
    return 0


def parse_frames(text: str) -> list[int]:
    """Return the frames of a list in Blender's notation, such as "1..50,60". Raises ArgumentTypeError."""
    frames: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(-?\d+)(?:\.\.(-?\d+))?\s*", part)
        first, last = (found[1], found[2] or found[1]) if found else ("1", "0")
        if int(first) > int(last):
            raise argparse.ArgumentTypeError(f"{part!r}: expected a frame or a range such as 1..50")
        frames += range(int(first), int(last) + 1)
    return list(dict.fromkeys(frames))


def render(scene: bpy.types.Scene, frames: Sequence[int]) -> tuple[int, int]:
    """Render the missing frames. Prints a line per frame as Blender does, because render farms parse it.

    Returns:
        The numbers of frames that this process rendered, and of those that existed or that others rendered.

    Raises:
        R5dgsError: A setting does not fit, or a frame cannot be rendered or written.
    """
    if scene.render.engine != engine.ENGINE:
        raise errors.ConfigError(
            f"scene {scene.name!r}: rendered by {scene.render.engine}; choose the render engine R5DGS, or use "
            "blender -a"
        )
    if scene.render.is_movie_format:
        raise errors.ConfigError(
            f"scene {scene.name!r}: a video cannot be shared between processes; choose an image format, such as -F PNG"
        )
    paths = [(frame, _paths(scene, frame)[0]) for frame in frames]
    _create_folders({path.parent for _, path in paths})
    rendered = 0
    for frame, drawn in shared_frames.fill(paths, lambda frame, path: _render_frame(scene, frame, path)):
        rendered += drawn
        for path in _paths(scene, frame):
            print(f"Saved: '{path}'" if drawn else f'skipping existing frame "{path}"', flush=True)
    return rendered, len(paths) - rendered


def _range_of(scene: bpy.types.Scene) -> range:
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def _paths(scene: bpy.types.Scene, frame: int) -> list[Path]:
    """Return the files of a frame, one per view if views have files of their own."""
    render = scene.render
    apart = render.use_multiview and render.image_settings.views_format == "INDIVIDUAL"
    views = [view.name for view in render.views if view.use] if apart else [""]
    return [Path(bpy.path.abspath(render.frame_path(frame=frame, view=view))) for view in views]


def _create_folders(folders: set[Path]) -> None:
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise errors.ConfigError(f"{folder}: the folder cannot be created ({error}); choose another -o") from error


def _render_frame(scene: bpy.types.Scene, frame: int, path: Path) -> None:
    """Render a frame into a hidden folder, and then move its files. ``path``, the first of them, is moved last."""
    folder = path.with_name(f".{path.name}.part")
    try:
        shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed
        folder.mkdir()
        _render_into(folder, scene, frame)
        files = sorted(folder.iterdir(), key=lambda file: file.name == path.name)
        if not files or files[-1].name != path.name:
            raise errors.ConfigError(f"frame {frame}: Blender wrote no {path.name}; the render was stopped")
        for file in files:
            os.replace(file, path.with_name(file.name))
    except OSError as error:
        raise errors.ConfigError(f"{path}: cannot be written ({error})") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _render_into(folder: Path, scene: bpy.types.Scene, frame: int) -> None:
    """Render a frame into a folder, under the name that it has in the output folder."""
    first, last, output = scene.frame_start, scene.frame_end, scene.render.filepath
    try:
        scene.frame_start = frame
        scene.frame_end = frame
        if scene.frame_start != frame:
            raise errors.ConfigError(f"frame {frame}: Blender renders frames from {scene.frame_start} on")
        scene.render.filepath = f"{folder}{os.sep}{re.split(SEPARATORS, output)[-1]}"
        bpy.ops.render.render(animation=True, scene=scene.name)
    except RuntimeError as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        raise errors.BackendError(f"frame {frame}: {reason}") from error
    finally:
        scene.frame_start, scene.frame_end, scene.render.filepath = first, last, output


def register():
    """Register the command with Blender's command line."""
    global _handle
    _handle = bpy.utils.register_cli_command(NAME, run)


def unregister():
    """Undo `register`."""
    bpy.utils.unregister_cli_command(_handle)

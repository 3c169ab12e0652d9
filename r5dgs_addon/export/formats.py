"""Export of a loaded scene with its edits in any format of the core's registry."""

import os
import tempfile
import time
from collections.abc import Generator
from pathlib import Path

import bpy

from ...r5dgs_core import errors
from ...r5dgs_core.formats import registry
from ...r5dgs_core.scene import scene_file
from ..scene import loaded_scenes, presence_keys, timeline
from ..ui import plural
from ..ui.stepwise_operator import Outcome, Step, Steps
from ..worker import jobs
from . import frame_range, gaussians, scene

_POLL_S = 0.05


def steps(
    context: bpy.types.Context,
    collection: bpy.types.Collection,
    path: Path,
    format: registry.Format,
    which: str,
    *,
    every: bool,
    step: int = 1,
) -> Steps:
    """Write the visible objects of a loaded scene with their edits, in the world of the scene file.

    Args:
        context: Context with the scene's frames; objects hidden in its view layer are left out, except by keys of
            their presence.
        collection: Loaded scene.
        path: Output file; the frame number is appended to its name if each frame is a file of its own.
        format: Output format.
        which: Key of `gaussians.WHICH`.
        every: True for the scene's frame range, False for the current frame.
        step: Number of frames from one exported frame to the next.

    Returns:
        The outcome, with a warning for each part of the scene that the format loses.

    Raises:
        ConfigError: Nothing to export is visible or absent only for a time, a point cloud has lost its points, or the
            path is the source of a loaded scene.
        SceneFileError: The scene's own file is missing, or a file cannot be written.
    """
    scene.refuse_sources(path)
    wanted, times = gaussians.chosen(context, which), timeline.of_collection(collection)
    with presence_keys.ignored(loaded_scenes.members(collection, "CLOUD")):  # what enters later is exported too
        clouds = {one.object for one in gaussians.shown(context.evaluated_depsgraph_get(), wanted)}
    clouds &= set(collection.all_objects)
    if not clouds:
        raise gaussians.nothing_shown(wanted)
    frames = frame_range.frames_of(context.scene, every, step)
    numbers = tuple(frames) if every else None
    at = frames if every else [context.scene.frame_current_final]
    options = registry.Options(tuple(times.time(frame) for frame in at), numbers)
    further = len(numbers) if numbers and format.per_frame else 1
    edited = yield from scene.edited_steps(context, collection, clouds, further=further)
    targets = format.paths(path, options, edited.scene)
    yield Step(edited.done, edited.done + len(targets), f"writing {targets[0].name}", slow=True)
    try:
        if format.why_unavailable() is None:
            written = 0
            for written, target in enumerate(format.write(edited.scene, path, options), 1):
                yield Step(edited.done + written, edited.done + len(targets), target.name)
        else:
            written = yield from _by_worker(edited, path, format, options, len(targets))
    except OSError as error:
        raise errors.SceneFileError(f"{path}: cannot be written: {error}") from error
    files = path.name if targets == [path] else plural.of(written, "file")
    lost = [f"Lost in this format: {sentence}" for sentence in format.losses(edited.scene, options)]
    return Outcome(f"{files}: {format.label} of {plural.of(len(clouds), 'cloud')}", [*edited.notes, *lost])


def _by_worker(
    edited: scene.EditedScene, path: Path, format: registry.Format, options: registry.Options, count: int
) -> Generator[Step, None, int]:
    """Write a scene in the worker, whose Python may have the format's package. Returns the number of files.

    Stopping it stops the worker.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = scene_file.write(edited.scene, Path(folder) / "scene.r5dgs", precision="exact")
        arguments = {"format": format.name, "times": list(options.times), "frames": options.frames}
        where = {"scene": str(source), "path": os.path.abspath(path)}
        job = jobs.start([(f"writing {path.name}", "export", arguments | where)])
        try:
            while not job.done:
                yield Step(edited.done, edited.done + count, job.doing, slow=True)
                time.sleep(_POLL_S)
            return len(job.answer()[0]["files"])
        finally:
            if not job.done:
                job.cancel()

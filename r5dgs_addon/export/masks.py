"""Export of object masks as PNG and of object index and depth as EXR, for a range of frames."""

import functools
import json
import time
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import atomic_files, errors
from ...r5dgs_core.formats import image_files
from ..engine import render_passes, render_request, view_cameras
from ..scene import object_names
from ..ui import plural
from ..ui.stepwise_operator import Outcome, Step, Steps
from ..worker import jobs
from . import cameras, frame_range

POLL_S = 0.005  # polling interval of the worker
LAYER = "R5DGS"  # layer name of the EXR channels, as in Blender's own multilayer files
FORMATS = (
    ("PNG", "Masks", "PNG of 8 bits, or 16 if an id exceeds 255, in object_mask; 0 is the background"),
    ("EXR", "Index and Depth", "Multilayer OpenEXR in object_index: object index, depth and alpha, for the compositor"),
    ("BOTH", "Both", "Masks, and index with depth"),
)


def steps(context: bpy.types.Context, folder: Path, *, format: str, every: bool, step: int = 1) -> Steps:
    """Write ``object_mask/images/frame_0001.png``, ``object_index/frame_0001.exr`` and ``objects.json`` into a folder.

    Args:
        context: Context with camera, resolution and frames; objects hidden in its view layer are skipped.
        folder: Output folder, created if missing.
        format: Key of `FORMATS`.
        every: True for the scene's frame range, False for the current frame.
        step: Number of frames from one file to the next.

    Raises:
        R5dgsError: There is no camera, the worker cannot render, or a file cannot be written.
    """
    scene, names = context.scene, {}
    frames = frame_range.frames_of(scene, every, step)
    with frame_range.frame_kept(scene):
        for number, frame in enumerate(frames):
            yield Step(number, len(frames), f"frame {frame}")
            frame_range.go_to(scene, frame)
            depsgraph = context.evaluated_depsgraph_get()
            whole = functools.partial(view_cameras.of_camera, depsgraph, border=False)
            seen = render_request.shown(depsgraph, whole)
            job = jobs.start(render_request.steps(seen, ("owners", "depth", "alpha"), sky=False))
            try:
                while not job.done:
                    yield Step(number, len(frames), f"frame {frame}, {job.doing}")
                    time.sleep(POLL_S)
                _, arrays = job.answer()
            finally:
                if not job.done:
                    job.cancel()
            names |= _names(seen)
            try:
                _write(folder, cameras.image_name(frame), format, *planes(seen, arrays))
                atomic_files.write(
                    folder / "objects.json", (json.dumps(names, indent=1, ensure_ascii=False) + "\n").encode()
                )
            except OSError as error:
                raise errors.SceneFileError(f"{folder}: cannot be written: {error}") from error
    return Outcome(f"{folder}: {plural.of(len(frames), 'frame')} of {plural.of(len(names), 'object')}")


def planes(
    seen: render_request.VisibleParts, arrays: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Object index, depth and alpha of an image. Indices are those of the render engine, 0 for background.

    Args:
        seen: Rendered scene.
        arrays: ``owners``, ``depth`` and ``alpha`` from the worker. [H, W]

    Returns:
        Indices int64, z depths and alphas float32. [H, W] each
    """
    return render_passes.indices(arrays, seen), render_passes.depths(arrays), arrays["alpha"].astype(np.float32)


def _write(folder: Path, image: str, format: str, indices: np.ndarray, depth: np.ndarray, alpha: np.ndarray) -> None:
    if format in ("PNG", "BOTH"):
        if indices.max() > 65535:
            raise errors.ConfigError(f"pass index {indices.max()}: expected at most 65535 for a mask; set a lower one")
        path = folder / "object_mask" / image
        path.parent.mkdir(parents=True, exist_ok=True)
        image_files.write_png(path, indices.astype(np.uint8 if indices.max() < 256 else np.uint16))
    if format in ("EXR", "BOTH"):
        path = folder / "object_index" / Path(image).with_suffix(".exr").name
        path.parent.mkdir(parents=True, exist_ok=True)
        channels = {"IndexOB.X": indices.astype(np.float32), "Depth.Z": depth, "Alpha.V": alpha}
        image_files.write_exr(path, {f"{LAYER}.{name}": values for name, values in channels.items()})


def _names(seen: render_request.VisibleParts) -> dict[str, str]:
    """Names of the visible objects by index, in the format of a data set's ``objects.json``."""
    found = {}
    current = {collection: object_names.names(collection) for collection in seen.scenes}
    for instance in seen.instances:
        index, object_id = render_passes.index_of(instance), instance.object.r5dgs.object_id
        if index > 0:
            own = instance.object.name
            found.setdefault(str(index), current[instance.collection].get(object_id, own) if object_id > 0 else own)
    return found

"""Cycles render of a view: display colours, as Blender shows them, and object id of every pixel."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from . import files
from .overrides import Overrides
from .settings import CaptureSettings

OBJECT_INDEX = (".IndexOB.X", ".Object Index.X")  # Blender 4, Blender 5
SWITCHED_OFF = (
    *("use_border", "use_compositing", "use_sequencer", "use_multiview", "use_motion_blur", "use_freestyle"),
    *("use_stamp", "use_file_extension", "use_placeholder"),
)


def prepare(context: bpy.types.Context, settings: CaptureSettings, overrides: Overrides) -> Path:
    """Set up the scene for `render_view` until the overrides end.

    Args:
        context: Context whose scene and view layer are rendered.
        settings: Resolution, samples, film and colour.
        overrides: Records every change.

    Returns:
        Folder for temporary files, removed when the overrides end.
    """
    scene, layer = context.scene, context.view_layer
    render, change = scene.render, overrides.set
    try:
        change(render, "engine", "CYCLES")
    except TypeError as error:
        raise errors.BackendError("capture: the Cycles render engine is needed; enable its add-on") from error
    change(render, "resolution_x", settings.resolution_x)
    change(render, "resolution_y", settings.resolution_y)
    change(render, "resolution_percentage", 100)
    change(render, "film_transparent", settings.transparent)
    change(render, "dither_intensity", 0.0)
    change(render, "use_persistent_data", True)
    change(render, "filepath", render.filepath)
    for axis in "xy":
        change(render, f"pixel_aspect_{axis}", 1.0)
    for name in SWITCHED_OFF:
        change(render, name, False)
    change(render, "use_overwrite", True)
    cycles = scene.cycles
    change(cycles, "device", settings.device)
    change(cycles, "samples", settings.samples)
    change(cycles, "seed", settings.seed)
    change(cycles, "use_animated_seed", False)
    change(cycles, "time_limit", 0.0)
    change(cycles, "use_denoising", settings.denoise)
    change(layer.cycles, "use_denoising", settings.denoise)
    change(scene, "camera", scene.camera)
    for marker in scene.timeline_markers:
        change(marker, "camera", None)
    for other in scene.view_layers:
        change(other, "use", other == layer)
    change(layer, "samples", 0)
    change(layer, "use_pass_combined", True)
    change(layer, "use_pass_object_index", True)
    if settings.view_transform:
        try:
            change(scene.display_settings, "display_device", "sRGB")
            change(scene.view_settings, "look", "None")  # before the view transform, so that it is restored after it
            change(scene.view_settings, "view_transform", settings.view_transform)
        except TypeError as error:
            raise errors.ConfigError(f"capture.view_transform: {error}") from error
    overrides.keep_image_format(render.image_settings)
    change(render.image_settings, "color_management", "FOLLOW_SCENE")
    return Path(overrides.enter_context(tempfile.TemporaryDirectory(prefix="r5dgs-capture-")))


def render_view(
    context: bpy.types.Context, camera: bpy.types.Object, transparent: bool, folder: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Render the scene's current frame from a camera.

    Colours are read from a PNG written by Blender, so that its view transform is reproduced exactly.

    Args:
        context: Context whose scene was set up by `prepare`.
        camera: Camera to render from.
        transparent: True to keep alpha.
        folder: Folder for temporary files.

    Returns:
        Display sRGB with straight alpha [H, W, 3 or 4] uint8, and object ids [H, W] int32.

    Raises:
        BackendError: Cycles failed.
    """
    scene = context.scene
    exr, png = folder / "passes.exr", folder / "color.png"
    scene.camera = camera
    scene.render.filepath = str(exr)
    _set_format(scene.render.image_settings, "OPEN_EXR_MULTILAYER", "32", "RGBA")
    try:
        with _quiet_stdout():
            bpy.ops.render.render(write_still=True, scene=scene.name, layer=context.view_layer.name)
    except RuntimeError as error:
        remedy = "; switch denoising off" if "denois" in str(error).lower() else ""
        message = str(error).removeprefix("Error: ").splitlines()[0]
        raise errors.BackendError(f"capture: {message}{remedy}") from error
    if not exr.is_file():
        raise errors.BackendError(f"capture: Cycles rendered nothing from camera {camera.name!r}; see the console")
    _set_format(scene.render.image_settings, "PNG", "8", "RGBA" if transparent else "RGB")
    scene.render.image_settings.compression = 0
    bpy.data.images["Render Result"].save_render(str(png), scene=scene)
    image = files.read_png(png)
    ids = np.rint(files.read_exr_channel(exr, OBJECT_INDEX)).astype(np.int32)
    exr.unlink()
    png.unlink()
    return image, ids


def _set_format(settings: bpy.types.ImageFormatSettings, file_format: str, depth: str, mode: str) -> None:
    if hasattr(settings, "media_type"):  # Blender 5: media type determines the available file formats
        settings.media_type = "MULTI_LAYER_IMAGE" if file_format == "OPEN_EXR_MULTILAYER" else "IMAGE"
    settings.file_format = file_format
    settings.color_mode = mode
    settings.color_depth = depth


@contextmanager
def _quiet_stdout() -> Iterator[None]:
    """Suppress the lines that Cycles prints for every step in background mode."""
    if not bpy.app.background:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)

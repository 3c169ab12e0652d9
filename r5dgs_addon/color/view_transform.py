"""Inverse tables of Blender's view transforms, which preserve trained colours under AgX, Filmic and others.

Tables are computed from samples that Blender itself displays, for any OpenColorIO configuration. Sampling creates
data-blocks, so it runs in Blender's main thread. It takes about a second per colour management. With a window, a timer
computes requested tables; a render, which runs in another thread, waits for them.
"""

import functools
import logging
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...r5dgs_core.color import view_inverse
from .. import compat
from ..ui import status_bar

DISPLAY = "sRGB"  # display device of the training images
POLL_S = 0.25  # timer interval
REST_S = 0.3  # delay after the last viewport request, because sliders change continuously
WAIT_S = 30.0  # maximum wait of a render
KEPT = 4  # number of cached tables (half a megabyte each, curves one megabyte)

_log = logging.getLogger(__name__)
_WIDTH = 512  # width of the sample images (px)
_CURVES = ("tone", "extend", "use_clip")
_LEVELS = ("black_level", "white_level")

# Matrices from linear Rec.709 to the other working spaces of a .blend (ACEScg white adapted by Bradford).
_WORKING_SPACES = {
    "Linear Rec.2020": (
        (0.6274039, 0.3292830, 0.0433131),
        (0.0690973, 0.9195404, 0.0113623),
        (0.0163914, 0.0880133, 0.8955953),
    ),
    "ACEScg": (
        (0.6130974, 0.3395231, 0.0473795),
        (0.0701937, 0.9163539, 0.0134524),
        (0.0206156, 0.1095698, 0.8698146),
    ),
}


@dataclass(frozen=True)
class Management:
    """Settings that determine the displayed colours. Equal instances display colours alike.

    Attributes:
        space: Scene-linear color space of the .blend.
        device: Display device.
        transform: View transform.
        look: Look.
        exposure: Exposure in stops.
        gamma: Gamma.
        curves: Curve settings and points, or None if curves are off.
        balance: White balance settings, or None if it is off.
    """

    space: str
    device: str
    transform: str
    look: str
    exposure: float
    gamma: float
    curves: tuple | None
    balance: tuple | None

    def apply(self, scene: bpy.types.Scene) -> None:
        """Apply the settings to a new scene, whose curves are still straight."""
        scene.display_settings.display_device = self.device
        view = scene.view_settings
        view.view_transform = self.transform
        view.look = self.look  # after the view transform, which determines the available looks
        view.exposure, view.gamma = self.exposure, self.gamma
        if self.balance is not None:
            view.use_white_balance = True
            view.white_balance_temperature, view.white_balance_tint = self.balance
        if self.curves is None:
            return
        view.use_curve_mapping = True
        mapping, (settings, levels, curves) = view.curve_mapping, self.curves
        for name, value in zip((*_CURVES, *_LEVELS), (*settings, *levels), strict=True):
            setattr(mapping, name, value)
        for curve, points in zip(mapping.curves, curves, strict=True):
            while len(curve.points) < len(points):
                curve.points.new(0.5, 0.5)
            for point, (x, y, handle) in zip(curve.points, points, strict=True):
                point.location, point.handle_type = (x, y), handle
        mapping.update()


def of(scene: bpy.types.Scene) -> Management:
    """Return the settings of a scene."""
    view, curves, balance = scene.view_settings, None, None
    if view.use_curve_mapping:
        mapping = view.curve_mapping
        curves = (
            tuple(getattr(mapping, name) for name in _CURVES),
            tuple(tuple(getattr(mapping, name)) for name in _LEVELS),
            tuple(tuple((*point.location, point.handle_type) for point in curve.points) for curve in mapping.curves),
        )
    if getattr(view, "use_white_balance", False):
        balance = (view.white_balance_temperature, view.white_balance_tint)
    device = scene.display_settings.display_device
    settings = (view.view_transform, view.look, view.exposure, view.gamma)
    return Management(compat.working_space(), device, *settings, curves, balance)


def in_space(linear: np.ndarray, space: str) -> np.ndarray:
    """Convert linear Rec.709, the space of all inverse tables, to a scene-linear space of a .blend. [..., 3]"""
    matrix = _WORKING_SPACES.get(space)
    return linear if matrix is None else linear @ np.array(matrix, np.float32).T


_inverses: dict[Management, view_inverse.Inverse | None] = {}  # None if Blender could not display the samples
_wanted: dict[Management, float] = {}  # requested tables and the time from which the timer computes them


def is_supported(scene: bpy.types.Scene) -> bool:
    """True if tables support the scene's display device."""
    return scene.display_settings.display_device == DISPLAY


def cached_or_requested(scene: bpy.types.Scene) -> view_inverse.Inverse | None:
    """Return the inverse if cached; otherwise request it from the timer, replacing any earlier request.

    Writes no Blender data, so draw callbacks may call it.
    """
    management = of(scene)
    neutral = _neutral(management)
    if neutral not in _inverses and neutral not in _wanted:
        _wanted.clear()
        _wanted[neutral] = time.monotonic() + REST_S
    found = _inverses.get(neutral)
    return found if found is None or neutral == management else _exposed(found, management.exposure)


def wait(scene: bpy.types.Scene, stopped: Callable[[], bool]) -> None:
    """Compute the inverse of a scene's view in the main thread, or wait for the timer for up to `WAIT_S`.

    Args:
        scene: Original or evaluated scene.
        stopped: Callback that returns True to stop waiting; polled often.
    """
    neutral = _neutral(of(scene))
    if neutral not in _inverses and (bpy.app.background or threading.current_thread() is threading.main_thread()):
        _make(neutral)
    end = time.monotonic() + WAIT_S
    while neutral not in _inverses and time.monotonic() < end and not stopped():
        _wanted.setdefault(neutral, 0.0)
        time.sleep(0.02)


def _neutral(management: Management) -> Management:
    """Settings of the table to use: exposure only scales scene-linear colours, unless curves are active."""
    return management if management.curves else replace(management, exposure=0.0)


@functools.lru_cache(maxsize=KEPT)
def _exposed(inverse: view_inverse.Inverse, exposure: float) -> view_inverse.Inverse:
    """Inverse of a view with another exposure, cached so that the same object is returned each time."""
    return replace(inverse, scale=inverse.scale * 2.0**-exposure)


def _make(management: Management) -> None:
    """Compute an inverse. A failure, for example on a full disk, is logged and not retried."""
    made = None
    try:
        sampler = _Sampler(management)
        try:
            made = view_inverse.invert(sampler.displayed, 2.0**-management.exposure)
        finally:
            sampler.close()
    except (OSError, RuntimeError) as error:
        _log.warning("R5DGS: no inverse of the view %s: %s", management.transform, error)
    while len(_inverses) >= KEPT:
        del _inverses[next(iter(_inverses))]
    _inverses[management] = made


def loss(
    management: Management,
    inverse: view_inverse.Inverse,
    display: np.ndarray,  # [N, 3]
    weights: np.ndarray,  # [N]
) -> view_inverse.Loss | None:
    """`view_inverse.loss` of a view from colours that Blender displays, or None if sampling fails (full disk)."""
    try:
        sampler = _Sampler(management)
        try:
            return view_inverse.loss(sampler.displayed, inverse, display, weights)
        finally:
            sampler.close()
    except (OSError, RuntimeError) as error:
        _log.warning("R5DGS: the loss under the view %s is not known: %s", management.transform, error)
        return None


class _Sampler:
    """Converts colours to display colours by saving images through a temporary scene."""

    def __init__(self, management: Management):
        self._space = management.space
        self._folder = tempfile.TemporaryDirectory(prefix="r5dgs_view_")
        self._scene = bpy.data.scenes.new("R5DGS view")
        management.apply(self._scene)
        self._scene.render.dither_intensity = 0.0
        settings: Any = self._scene.render.image_settings
        settings.file_format, settings.tiff_codec = "TIFF", "NONE"
        settings.color_mode, settings.color_depth = "RGB", "16"

    def displayed(self, colors: np.ndarray) -> np.ndarray:
        """Display colours of linear Rec.709 colours, in which per-channel views act per channel. [N, 3] both"""
        path = str(Path(self._folder.name) / "samples.tif")
        height = -(-len(colors) // _WIDTH)
        pixels = np.ones((height * _WIDTH, 4), np.float32)
        pixels[: len(colors), :3] = in_space(colors, self._space)
        image = bpy.data.images.new("R5DGS view", _WIDTH, height, alpha=True, float_buffer=True)
        try:
            image.colorspace_settings.name = self._space
            image.pixels.foreach_set(pixels.ravel())
            image.update()
            image.save_render(path, scene=self._scene)
        finally:
            bpy.data.images.remove(image)
        image = bpy.data.images.load(path)
        try:
            image.colorspace_settings.name = "Non-Color"
            image.pixels.foreach_get(pixels.ravel())
        finally:
            bpy.data.images.remove(image)
        return pixels[: len(colors), :3]

    def close(self) -> None:
        """Remove the temporary scene and folder."""
        compat.remove_scene(self._scene)
        self._folder.cleanup()


def compute_due() -> float:
    """Compute the requested tables that are due. Returns the timer interval in seconds."""
    for management, since in list(_wanted.items()):
        if time.monotonic() < since:
            continue
        _wanted.pop(management, None)
        if management not in _inverses:
            _make(management)
            status_bar.redraw("VIEW_3D", "PROPERTIES")
    return POLL_S


def register():
    """Start the timer."""
    bpy.app.timers.register(compute_due, first_interval=POLL_S, persistent=True)


def unregister():
    """Stop the timer and clear the caches."""
    if bpy.app.timers.is_registered(compute_due):
        bpy.app.timers.unregister(compute_due)
    _wanted.clear()
    _inverses.clear()
    _exposed.cache_clear()

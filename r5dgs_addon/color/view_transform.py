"""View transforms of Blender scenes, inverted, so that colours come out as trained under AgX, Filmic and others, too.

The table is made from samples that Blender itself displays, whatever configuration of OpenColorIO it has. Sampling
makes data, and so is for Blender's own thread; it takes about a second, once for each colour management that is used.
With a window a timer makes the table when it is wanted, and a render, in a thread of its own, waits for it.
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

DISPLAY = "sRGB"  # what pictures were trained for
LOOK_S = 0.25  # between two looks at what is wanted
REST_S = 0.3  # what a viewport wants is made when it has wanted nothing else for so long: sliders move
WAIT_S = 30.0  # a render waits no longer
KEPT = 4  # tables, of half a megabyte and curves of one

_log = logging.getLogger(__name__)
_WIDTH = 512  # of images of samples
_CURVES = ("tone", "extend", "use_clip")
_LEVELS = ("black_level", "white_level")

# Linear Rec.709 to the other scene-linear spaces that a .blend can have (ACEScg adapted to its white by Bradford).
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
    """The settings that decide how colours are displayed; equal where they are displayed alike.

    Attributes:
        space: Scene-linear color space of the .blend.
        device: The display.
        transform: The view transform.
        look: The look.
        exposure: In stops.
        gamma: The gamma.
        curves: Settings of the curves and their points, or None where they are off.
        balance: Settings of the white balance, or None where it is off.
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
        """Give a scene these settings; one that is new, with straight curves."""
        scene.display_settings.display_device = self.device
        view = scene.view_settings
        view.view_transform = self.transform
        view.look = self.look  # after the view transform, which decides what looks there are
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
    """The settings of a scene."""
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
    """Linear Rec.709, in which inverses are made and given, in a scene-linear space of a .blend. [..., 3]"""
    matrix = _WORKING_SPACES.get(space)
    return linear if matrix is None else linear @ np.array(matrix, np.float32).T


_inverses: dict[Management, view_inverse.Inverse | None] = {}  # None where Blender could not display samples
_wanted: dict[Management, float] = {}  # what the timer shall make, and from when on


def can(scene: bpy.types.Scene) -> bool:
    """Whether the display of a scene is one that tables are made for."""
    return scene.display_settings.display_device == DISPLAY


def want(scene: bpy.types.Scene) -> view_inverse.Inverse | None:
    """The inverse where it is made already; where it is not, the timer makes it when nothing else is wanted.

    No data is written, so drawing may call it.
    """
    management = of(scene)
    neutral = _neutral(management)
    if neutral not in _inverses and neutral not in _wanted:
        _wanted.clear()
        _wanted[neutral] = time.monotonic() + REST_S
    found = _inverses.get(neutral)
    return found if found is None or neutral == management else _exposed(found, management.exposure)


def wait(scene: bpy.types.Scene, stopped: Callable[[], bool]) -> None:
    """Have the inverse of a scene's view made, now where this is Blender's own thread, else in time or not.

    Args:
        scene: Evaluated or not.
        stopped: Whether to wait no longer; called often.
    """
    neutral = _neutral(of(scene))
    if neutral not in _inverses and (bpy.app.background or threading.current_thread() is threading.main_thread()):
        _make(neutral)
    end = time.monotonic() + WAIT_S
    while neutral not in _inverses and time.monotonic() < end and not stopped():
        _wanted.setdefault(neutral, 0.0)
        time.sleep(0.02)


def _neutral(management: Management) -> Management:
    """The settings that a table is made for: an exposure is a factor of the scene's colours, but for curves."""
    return management if management.curves else replace(management, exposure=0.0)


@functools.lru_cache(maxsize=KEPT)
def _exposed(inverse: view_inverse.Inverse, exposure: float) -> view_inverse.Inverse:
    """The inverse of a view with another exposure; the same one each time."""
    return replace(inverse, scale=inverse.scale * 2.0**-exposure)


def _make(management: Management) -> None:
    """Make an inverse; where that fails, as on a full disk, the console says why and it is not tried again."""
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
    """`view_inverse.loss` of a view, from colours that Blender displays; None if it cannot, as on a full disk."""
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
    """Has Blender display colours: it saves images through a scene of their own."""

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
        """Display colours of linear Rec.709, in which views of single channels are such. [N, 3] both"""
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
        """Remove what was made."""
        compat.remove_scene(self._scene)
        self._folder.cleanup()


def look() -> float:
    """Make what is wanted for long enough. Returns seconds to the next look."""
    for management, since in list(_wanted.items()):
        if time.monotonic() < since:
            continue
        _wanted.pop(management, None)
        if management not in _inverses:
            _make(management)
            status_bar.redraw("VIEW_3D", "PROPERTIES")
    return LOOK_S


def register():
    """Begin to look at what is wanted."""
    bpy.app.timers.register(look, first_interval=LOOK_S, persistent=True)


def unregister():
    """Undo `register`, and forget all tables."""
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)
    _wanted.clear()
    _inverses.clear()
    _exposed.cache_clear()

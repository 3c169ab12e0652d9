"""Rendered viewports. Each draws its last image and requests the next one from the worker without blocking.

While a view moves, images are small and only the latest request counts. When it rests, an image of full size follows.
A timer in Blender's main thread submits requests and receives images.
"""

import functools
import time
import weakref
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.presets import draw_texture_2d

from ...r5dgs_core import errors
from ...r5dgs_core.color import view_inverse
from ...r5dgs_core.protocol import messages
from ...r5dgs_core.scene import cameras
from ..color import display_to_linear
from ..scene import render_settings
from ..ui import plural, status_bar
from ..worker import jobs
from . import render_passes, render_request, view_cameras

KEY = "viewport"  # job key for `jobs.busy`
POLL_S = 0.01  # polling interval of the worker
REST_S = 0.15  # time without movement after which a view counts as resting
QUICK_MS = 40.0  # full-size images that render at least this fast are requested even while the view moves
FULL = 1

_viewports: "weakref.WeakSet[ViewportImage]" = weakref.WeakSet()
_running: "tuple[jobs.Job, ViewportImage, ImageRequest, int] | None" = None


class ImageRequest:
    """Image requested by a viewport.

    Args:
        seen: Visible parts of the scenes, with a camera of full size.
        sky: True to draw the sky as background.
        transparent: True if the film is transparent.
        moving_reduction: Factor by which the image is smaller while the view moves.
        inverse: Inverse of the view transform, or None for *Standard*.
    """

    def __init__(
        self,
        seen: render_request.VisibleParts,
        sky: bool,
        transparent: bool,
        moving_reduction: int,
        inverse: view_inverse.Inverse | None = None,
    ):
        self.camera = seen.camera
        self.transparent = transparent
        self.moving_reduction = moving_reduction
        self.inverse = inverse
        self.steps = render_request.steps(seen, ("alpha",) if transparent else (), sky)
        self.since = time.monotonic()

    def same(self, other: "ImageRequest | None") -> bool:
        """True if another request is for the same image."""
        if other is None or self.inverse is not other.inverse:
            return False
        return (self.steps, self.transparent) == (other.steps, other.transparent)

    def requests(self, reduction: int) -> list[tuple[str, str, dict[str, Any]]]:
        """Worker requests for the image, reduced in size by a factor."""
        *before, (doing, command, arguments) = self.steps
        if reduction == FULL:
            return self.steps
        size = (max(self.camera.width // reduction, 1), max(self.camera.height // reduction, 1))
        camera = messages.camera_to_json(cameras.resize(self.camera, *size))
        return [*before, (doing, command, {**arguments, "camera": camera})]


class ViewportImage:
    """State of a viewport: requested image, last image, and render time."""

    def __init__(self):
        self._requested: ImageRequest | None = None
        self._shown: tuple[ImageRequest, int] | None = None  # request of the shown image, and its reduction factor
        self._failed: ImageRequest | None = None
        self._pixels: np.ndarray | None = None  # image not yet uploaded to the GPU
        self._texture = None
        self._message = ""
        self._full_ms = 1e9
        _viewports.add(self)

    def draw(self, engine: bpy.types.RenderEngine, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw the last image over the region and request the current view."""
        region, scene = context.region, depsgraph.scene
        try:
            self.request(_request(context, depsgraph))
        except errors.R5dgsError as error:
            self._requested = self._shown = self._pixels = self._texture = None
            self._message = str(error)
        if self._pixels is not None:
            height, width = self._pixels.shape[:2]
            data = gpu.types.Buffer("FLOAT", self._pixels.size, self._pixels.ravel())
            self._texture, self._pixels = gpu.types.GPUTexture((width, height), format="RGBA16F", data=data), None
        if self._texture is not None:
            gpu.state.blend_set("ALPHA_PREMULT")
            engine.bind_display_space_shader(scene)
            draw_texture_2d(self._texture, (0, 0), region.width, region.height)
            engine.unbind_display_space_shader()
            gpu.state.blend_set("NONE")
        engine.update_stats("R5DGS", self._message)

    def request(self, request: ImageRequest) -> None:
        """Set the requested image. Does nothing if it equals the current request."""
        if not request.same(self._requested):
            self._requested, self._failed = request, None
        if self.next() is not None and not bpy.app.timers.is_registered(poll):
            bpy.app.timers.register(poll, first_interval=0.0)

    def next(self) -> tuple[ImageRequest, int] | None:
        """Next request and its reduction factor, or None if the shown image is up to date."""
        request = self._requested
        if request is None or request.same(self._failed):
            return None
        done = self._shown is not None and request.same(self._shown[0])
        if done and self._shown[1] == FULL:
            return None
        quick = self._full_ms <= QUICK_MS or request.moving_reduction == FULL
        return request, FULL if done or quick else request.moving_reduction

    def rests(self) -> bool:
        """True if the view has not moved for `REST_S`."""
        return self._requested is not None and time.monotonic() - self._requested.since >= REST_S

    def take(self, request: ImageRequest, reduction: int, answer: tuple[dict[str, Any], dict[str, np.ndarray]]) -> None:
        """Store an image from the worker for the next redraw."""
        result, arrays = answer
        milliseconds = result["ms_motion"] + result["ms_raster"]
        alpha = render_passes.alpha(arrays, request.transparent)
        linear = display_to_linear.scene_linear(arrays["color"], alpha, request.inverse)
        self._pixels = np.ascontiguousarray(linear[::-1])
        self._shown = request, reduction
        if reduction == FULL:
            self._full_ms = milliseconds
        self._message = f"{plural.of(result['gaussians'], 'Gaussian')} in {milliseconds:.0f} ms"

    def set_message(self, message: str) -> None:
        """Show a status text in the viewport's corner."""
        self._message = message

    def fail(self, request: ImageRequest, error: errors.R5dgsError) -> None:
        """Show an error, and do not repeat the request until it changes."""
        self._failed, self._message = request, str(error)


def _request(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> ImageRequest:
    """Return the request for the viewport that is being drawn."""
    scene, settings = depsgraph.scene, render_settings.of(depsgraph.scene)
    looks = functools.partial(view_cameras.of_region, context.region, context.region_data)
    seen = render_request.shown(depsgraph, looks, context.space_data)
    if not seen.scenes:
        raise errors.ConfigError("No R5DGS scene is shown; load one from File > Import")
    transparent = scene.render.film_transparent
    inverse = display_to_linear.inverse(scene)
    return ImageRequest(seen, settings.sky and not transparent, transparent, int(settings.moving), inverse)


def poll() -> float | None:
    """Receive a finished image and submit the next request. Returns the timer interval, or None to stop."""
    global _running
    if _running is not None:
        job, viewport, request, reduction = _running
        if not job.done:
            if job.seconds > 1.0:
                viewport.set_message(f"{job.doing[:1].upper()}{job.doing[1:]}, {job.seconds:.0f} s")
                status_bar.redraw("VIEW_3D")
            return POLL_S if job.seconds < 1.0 else 0.25
        _running = None
        try:
            viewport.take(request, reduction, job.answer())
        except errors.R5dgsError as error:
            viewport.fail(request, error)
        status_bar.redraw("VIEW_3D")
    waiting = [(viewport, *following) for viewport in _viewports if (following := viewport.next()) is not None]
    if not waiting:
        return None
    if jobs.busy() or bpy.app.is_job_running("RENDER"):
        return 0.1
    for viewport, request, reduction in sorted(waiting, key=lambda one: -one[2]):  # moving views first
        if reduction == FULL and request.moving_reduction != FULL and not viewport.rests():
            continue
        try:
            _running = jobs.submit(KEY, request.requests(reduction)), viewport, request, reduction
        except errors.R5dgsError as error:
            viewport.fail(request, error)
            status_bar.redraw("VIEW_3D")
        break
    return POLL_S


def forget() -> None:
    """Forget all viewports and stop the timer."""
    global _running
    _running = None
    _viewports.clear()
    if bpy.app.timers.is_registered(poll):
        bpy.app.timers.unregister(poll)

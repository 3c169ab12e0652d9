"""The R5DGS render engine: F12, animations and Rendered viewports with the worker's rasterizer.

An image shows the depsgraph (see `render_request`), so a frame of an animation equals the frame that F12 renders.
"""

import math
import time
from collections.abc import Sequence

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.color import view_inverse
from .. import compat
from ..color import display_to_linear, inverse_loss, view_transform
from ..scene import loaded_scenes, render_settings
from ..ui import plural
from ..worker import jobs
from . import (
    blur_samples,
    cryptomatte,
    mesh_merge,
    render_notes,
    render_passes,
    render_request,
    stereo,
    view_cameras,
    viewport,
    visible_meshes,
)

ENGINE = "R5DGS"
POLL_S = 0.005  # polling interval of the worker and of the user's request to stop
GRACE_S = 0.2  # time that a stopped render may take to finish before the worker is ended


class R5DGS_RenderEngine(bpy.types.RenderEngine):
    """Renders loaded R5DGS scenes as they were trained."""

    bl_idname = ENGINE
    bl_label = "R5DGS"
    bl_use_preview = False
    bl_use_eevee_viewport = True  # for Material Preview

    _viewport_image = None  # of the viewport that this engine instance draws
    _said = ""

    def update_render_passes(self, scene, renderlayer):
        """Register the passes with the compositor."""
        for one in render_passes.of_layer(renderlayer, mesh_merge.of(scene) is not None):
            self.register_pass(scene, renderlayer, one.name, len(one.channels), one.channels, one.kind)

    def render(self, depsgraph):
        """Render a view layer. Called once per frame, in a separate thread if there is a window.

        A reported error ends the render and prevents Blender from saving a black image.
        """
        try:
            self._render(depsgraph)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, f"R5DGS: {error}")
        except Exception as error:
            self.report({"ERROR"}, f"R5DGS: {type(error).__name__}: {error}; the console has more")
            raise

    def view_update(self, context, depsgraph):
        """Do nothing: `view_draw` follows and detects changes itself."""

    def view_draw(self, context, depsgraph):
        """Draw the last image of the viewport, and request another if the view has changed."""
        if self._viewport_image is None:
            self._viewport_image = viewport.ViewportImage()
        self._viewport_image.draw(self, context, depsgraph)

    def _render(self, depsgraph: bpy.types.Depsgraph) -> None:
        for view, camera in stereo.cameras(self, depsgraph.scene):
            if not self.test_break():
                self._render_view(depsgraph, view, camera)

    def _render_view(self, depsgraph: bpy.types.Depsgraph, view: str, camera: bpy.types.Object | None) -> None:
        scene, layer = depsgraph.scene, depsgraph.view_layer
        if not loaded_scenes.scene_collections():
            raise errors.ConfigError("expected a loaded R5DGS scene, found none; load one from File > Import first")
        inverse = display_to_linear.wait_for_inverse(scene, self.test_break)
        objections = display_to_linear.objections(scene)
        if objections:
            self.report(
                {"WARNING"},
                f"R5DGS: colors differ from the trained ones because of: {', '.join(objections)}; press 'Show Colors "
                "as Trained' in the render properties",
            )
        transparent = scene.render.film_transparent
        passes = render_passes.of_layer(layer, mesh_merge.of(scene) is not None)
        mattes = cryptomatte.pass_names(layer)
        seen = self._seen(depsgraph, camera)
        render_notes.report(self, render_notes.of(scene, depsgraph))
        if not seen.scenes:
            self.report({"WARNING"}, f"R5DGS: view layer {layer.name} shows no R5DGS scene")
        arrays = self._arrays(depsgraph, seen, passes, mattes)
        if arrays is None:
            return
        filled = {one.name: render_passes.pixels(one, arrays, seen, transparent, inverse) for one in passes}
        if seen.scenes and blur_samples.are_needed(depsgraph, camera or scene.camera):
            colors = [one for one in passes if one in render_passes.COLORS]
            blurred = self._mean_of_samples(depsgraph, camera, colors, inverse)
            if blurred is None:
                return
            filled |= blurred
        for one in passes[1:]:
            self.add_pass(one.name, len(one.channels), one.channels, layer=layer.name)
        rendered = self.begin_result(0, 0, seen.camera.width, seen.camera.height, layer=layer.name, view=view)
        render_passes.fill(rendered.layers[0], filled)
        self.end_result(rendered)
        if mattes:
            cryptomatte.write_names(self.get_result(), layer, seen)
        self.update_progress(1.0)

    def _seen(
        self, depsgraph: bpy.types.Depsgraph, camera: bpy.types.Object | None, point: np.ndarray | None = None
    ) -> render_request.VisibleParts:
        """Return the visible parts as a camera sees them.

        Args:
            depsgraph: Evaluated depsgraph.
            camera: Camera of a stereo view, or None for the scene's.
            point: Point of the lens that the rays pass, or None for the pinhole camera.
        """

        def view(points):
            found = view_cameras.of_camera(depsgraph, points, eye=stereo.eye(self, camera))
            lens = None if point is None else blur_samples.lens_of(camera or depsgraph.scene.camera, depsgraph)
            return found if lens is None else blur_samples.through_lens(found, lens, point)

        return render_request.shown(depsgraph, view)

    def _arrays(
        self,
        depsgraph: bpy.types.Depsgraph,
        seen: render_request.VisibleParts,
        passes: Sequence[render_passes.Pass],
        mattes: Sequence[str] = (),
    ) -> dict[str, np.ndarray] | None:
        """Render the arrays of passes. Returns None if the user stops the render."""
        if not seen.scenes:
            return render_passes.empty(seen.camera, cryptomatte.RANKS * len(mattes))
        scene = depsgraph.scene
        transparent = scene.render.film_transparent
        sky = render_settings.of(scene).sky and not transparent
        steps = render_request.steps(seen, render_passes.wanted(passes, transparent), sky)
        if mesh_merge.of(scene) is not None:
            steps[-1][-1]["meshes"] = visible_meshes.of(depsgraph).to_json()
        if mattes:
            steps[-1][-1]["coverage"] = cryptomatte.request(seen, len(mattes))
        return self._ask(steps)

    def _mean_of_samples(
        self,
        depsgraph: bpy.types.Depsgraph,
        camera: bpy.types.Object | None,
        passes: Sequence[render_passes.Pass],
        inverse: view_inverse.Inverse | None,
    ) -> dict[str, np.ndarray] | None:
        """Return the mean of passes over samples of lens and shutter, or None if the user stops the render."""
        scene = depsgraph.scene
        frame, shutter = scene.frame_current + scene.frame_subframe, blur_samples.shutter_of(scene)
        transparent, samples = scene.render.film_transparent, blur_samples.samples(render_settings.of(scene).samples)
        sums: dict[str, np.ndarray] = {}
        try:
            for number, sample in enumerate(samples):
                if shutter is not None:
                    self._set_frame(frame + shutter[0] + sample.time * (shutter[1] - shutter[0]))
                seen = self._seen(depsgraph, camera, sample.point)
                arrays = self._arrays(depsgraph, seen, passes)
                if arrays is None:
                    return None
                for one in passes:
                    added = render_passes.pixels(one, arrays, seen, transparent, inverse)
                    sums[one.name] = sums.get(one.name, 0) + added
                self.update_progress((number + 1) / len(samples))
        finally:
            if shutter is not None:
                self._set_frame(frame)
        return {name: total / np.float32(len(samples)) for name, total in sums.items()}

    def _set_frame(self, frame: float) -> None:
        """Evaluate the scene at a frame, sub-frame included."""
        self.frame_set(math.floor(frame), frame - math.floor(frame))

    def _ask(self, steps):
        """Return the worker's arrays, or None if the user stops the render."""
        job = jobs.start(steps)
        while not job.done:
            if self._stopped(job.doing):
                _leave(job)
                return None
        result, arrays = job.answer()
        milliseconds = result["ms_motion"] + result["ms_raster"]
        self._say(f"{plural.of(result['gaussians'], 'Gaussian')} in {milliseconds:.0f} ms")
        return arrays

    def _stopped(self, doing: str) -> bool:
        """Show the current status, wait briefly, and return True if the user wants to stop."""
        self._say(f"{doing[:1].upper()}{doing[1:]}")
        time.sleep(POLL_S)
        return self.test_break()

    def _say(self, text: str) -> None:
        """Show a status text in the render window and the console, unless it is unchanged."""
        if text != self._said:
            self._said = text
            self.update_stats("", text)


def _leave(job: jobs.Job) -> None:
    """Abandon a job. If it ends within `GRACE_S`, the worker is kept."""
    end = time.monotonic() + GRACE_S
    while not (job.done or job.drop()) and time.monotonic() < end:
        time.sleep(POLL_S)
    job.cancel()


def register():
    """Register settings and engine, and show Blender's engine-independent panels for it."""
    render_settings.register()
    view_transform.register()
    bpy.utils.register_class(R5DGS_RenderEngine)
    for panel in compat.panels_of_all_engines():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister():
    """Undo `register`."""
    viewport.forget()
    for panel in compat.panels_of_all_engines():
        panel.COMPAT_ENGINES.discard(ENGINE)
    bpy.utils.unregister_class(R5DGS_RenderEngine)
    inverse_loss.unregister()
    view_transform.unregister()
    render_settings.unregister()

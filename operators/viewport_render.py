"""Viewport Render with Splats operator: picture or animation of a 3D view; Blender's own omits Gaussians."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty

from ..r5dgs_addon.engine import engine, render_request, view_cameras
from ..r5dgs_addon.export import frame_range
from ..r5dgs_addon.scene import polls
from ..r5dgs_addon.splats import viewport_picture
from ..r5dgs_addon.ui import plural, stepwise_operator
from ..r5dgs_core.formats import image_files

IMAGE = "R5DGS Viewport"


class R5DGS_OT_viewport_render(stepwise_operator.Stepwise, polls.NeedsScene, bpy.types.Operator):
    """Draw this 3D view with its splats in the resolution of the scene"""

    bl_idname = "r5dgs.viewport_render"
    bl_label = "Viewport Render with Splats"
    bl_options = {"REGISTER"}
    work = "Viewport Render"

    animation: BoolProperty(
        name="Animation", description="Save the frame range as PNG files in the folder of the scene's output path"
    )

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if bpy.app.background or context.region_data is None:
            cls.poll_message_set("Move the mouse over a 3D view")
            return False
        if context.space_data.shading.type == "RENDERED" and context.scene.render.engine == engine.ENGINE:
            cls.poll_message_set("The engine R5DGS draws this view: press F12 instead, or choose another shading")
            return False
        return True

    def suggest(self, context):
        return True

    def steps(self, context):
        view = {name: getattr(context, name) for name in ("window", "area", "region")}
        return self._draw(context, context.scene, view)

    def _draw(self, context, scene, view):
        frames, path = frame_range.frames_of(scene, self.animation, scene.frame_step), None
        with frame_range.frame_kept(scene):
            for number, frame in enumerate(frames):
                yield stepwise_operator.Step(number, len(frames), f"frame {frame}")
                frame_range.go_to(scene, frame)
                with context.temp_override(**view):
                    color = viewport_picture.draw(bpy.context, *view_cameras.size_of(scene))
                if self.animation:
                    path = Path(bpy.path.abspath(scene.render.frame_path(frame=frame))).with_suffix(".png")
                    path.parent.mkdir(parents=True, exist_ok=True)
                    image_files.write_png(path, (255 * color + 0.5).astype("uint8"))
        if path is not None:
            return stepwise_operator.Outcome(f"{plural.of(len(frames), 'frame')} saved in {path.parent}")
        image = render_request.write_image(IMAGE, color)
        hint = "" if render_request.show(context, image) else f": open an Image Editor and choose '{IMAGE}'"
        return stepwise_operator.Outcome(IMAGE + hint)


CLASSES = (R5DGS_OT_viewport_render,)

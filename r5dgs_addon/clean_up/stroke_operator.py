"""Base class of the operators that select Gaussians by a stroke of the mouse."""

import math

import bpy
import numpy as np
from bpy.props import CollectionProperty, EnumProperty

from ...r5dgs_core import errors
from ..scene import loaded_scenes, polls
from ..ui import plural
from . import overlay, selected_points, strokes

STEP = 3  # pixels between two places of a stroke


class StrokeOperator(polls.NeedsScene):
    """Mixin for operators that follow the mouse while its button is pressed; each stroke is one undo step.

    A subclass may define `radius`, in pixels; without it, the stroke is a lasso.
    """

    path: CollectionProperty(
        name="Path", description="Places of the stroke in the region", type=bpy.types.OperatorMousePath
    )
    mode: EnumProperty(name="Mode", description="Change of the selection", items=selected_points.MODES)
    depth: EnumProperty(name="Depth", description="Depth of the selected Gaussians", items=strokes.DEPTHS)

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        if context.region_data is None:
            cls.poll_message_set("Use this in a 3D view")
            return False
        return super().poll(context)

    def invoke(self, context, event):
        self.path.clear()
        self._places = [(event.mouse_region_x, event.mouse_region_y)]
        radius = getattr(self, "radius", None)
        drawn = (self._places, radius is None, radius)
        self._handle = bpy.types.SpaceView3D.draw_handler_add(overlay.draw_path, drawn, "WINDOW", "POST_PIXEL")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        place = (event.mouse_region_x, event.mouse_region_y)
        if event.type == "MOUSEMOVE" and math.dist(place, self._places[-1]) >= STEP:
            self._places.append(place)
            context.area.tag_redraw()
        if event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._stop(context)
            for place in self._places:
                self.path.add().loc = place
            return self.execute(context)
        if event.type in ("ESC", "RIGHTMOUSE"):
            self._stop(context)
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Remove the drawing if Blender ends the operator."""
        self._stop(context)

    def _stop(self, context) -> None:
        bpy.types.SpaceView3D.draw_handler_remove(self._handle, "WINDOW")
        context.area.tag_redraw()

    def execute(self, context):
        if not self.path:
            self.report({"ERROR"}, "No stroke: drag in a 3D view, or give a path")
            return {"CANCELLED"}
        path = np.array([item.loc for item in self.path], np.float64)
        stroke = strokes.Stroke(path, getattr(self, "radius", None), self.depth == "FRONT")
        collection = loaded_scenes.active_collection(context)
        try:
            count = strokes.select(context, collection, strokes.StrokeView.of(context), stroke, self.mode)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{plural.of(count, 'Gaussian')} selected")
        return {"FINISHED"}

"""*Observed Motion* panel: segments, events and pose errors of the active object up to the last observed time."""

import math

import bpy
import numpy as np

from ...r5dgs_core.motion import models
from ...r5dgs_core.motion.history import Event, Segment
from ..motion import duplicate_delete, extrapolate, motion_fields, physics, warnings
from ..scene import timeline
from . import motion, sidebar

_SLIGHT = 0.1  # change of the speed within a segment that is not shown, as a fraction of the speed


class R5DGS_PT_observed_motion(sidebar.Sidebar, bpy.types.Panel):
    """Segments, events and errors of the poses of the active object."""

    bl_idname = "R5DGS_PT_observed_motion"
    bl_parent_id = motion.R5DGS_PT_motion.bl_idname
    bl_label = "Observed Motion"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        anchor = duplicate_delete.active_anchor(context)
        return anchor is not None and bool(physics.history(anchor).segments or warnings.errors_of_poses(anchor))

    def draw(self, context):
        anchor = duplicate_delete.active_anchor(context)
        found, times = physics.history(anchor), extrapolate.times_of(anchor)
        for number, segment in enumerate(found.segments):
            column = self.layout.column(align=True)
            start, stop = times.frame(segment.start), times.frame(segment.stop)
            column.label(text=f"{start:.0f} to {stop:.0f}: {models.KINDS[segment.kind].label}", icon="CURVE_PATH")
            for line in _rates(segment, anchor.r5dgs_motion, context.scene.unit_settings.system):
                column.label(text=line, icon="BLANK1")
            if number < len(found.events):
                self.layout.label(text=_event(found.events[number], times), icon="MARKER")
        errors = warnings.errors_of_poses(anchor)
        if errors:
            column = self.layout.column(align=True)
            for line in errors:
                column.label(text=line, icon="DRIVER_DISTANCE")
        motion.draw_warning(self.layout, anchor)


def _event(event: Event, times: timeline.Times) -> str:
    """Event in words, such as "Frame 31.2 ± 0.6: impact"."""
    sigma = event.sigma * times.frames_per_unit
    doubt = f" ± {sigma:.1f}" if sigma >= 0.05 else ""
    return f"Frame {times.frame(event.time):.1f}{doubt}: {event.kind}"


def _rates(segment: Segment, state: bpy.types.PropertyGroup, system: str) -> list[str]:
    """Rates at the end of a segment in words, per second of Blender's time."""
    factor = motion_fields.units_per_second(state)
    speed, change, spin = (
        float(np.linalg.norm(segment.parameters.get(name, np.zeros(3)))) * factor**power
        for name, power in (("velocity", 1), ("acceleration", 2), ("angular_velocity", 1))
    )
    found = []
    if segment.kind == "static":
        return found
    found.append(f"moves at {bpy.utils.units.to_string(system, 'VELOCITY', speed, precision=3)}")
    if change * (segment.stop - segment.start) / factor > _SLIGHT * speed:
        found.append(f"accelerates by {bpy.utils.units.to_string(system, 'ACCELERATION', change, precision=3)}")
    if spin > 0:
        found.append(f"turns by {math.degrees(spin):.3g}°/s")
    return found


CLASSES = (R5DGS_PT_observed_motion,)

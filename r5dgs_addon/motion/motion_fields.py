"""Fields of an anchor's motion past t_max, for the panel *Motion*.

Rates are stored per unit of scene time, as in the core, and shown per second of Blender's time. Vectors are in the
axes of the anchor's parent, like its location.
"""

import contextlib
import math
from collections.abc import Callable, Iterator

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, PointerProperty, StringProperty

from ...r5dgs_core import errors
from ...r5dgs_core.motion import models
from ..scene import timeline

VECTORS = {name: unit for name, unit in models.FIELDS.items() if unit.size == 3}
_re_extrapolate: Callable[[list[bpy.types.Object]], object] | None = None  # set by `extrapolate`


def units_per_second(state: bpy.types.PropertyGroup | timeline.Times) -> float:
    """Units of scene time per second of Blender's time, for fields of an anchor or times of a loaded scene."""
    render = bpy.context.scene.render
    return render.fps / render.fps_base / state.frames_per_unit


def write_at_once(state: bpy.types.PropertyGroup, _) -> None:
    """Update callback of the fields: re-extrapolate the anchor if *Write at Once* is on."""
    if state.at_once and _re_extrapolate is not None:
        with contextlib.suppress(errors.R5dgsError):  # shown in the panel
            _re_extrapolate([state.id_data])


@contextlib.contextmanager
def not_at_once(state: bpy.types.PropertyGroup) -> Iterator[None]:
    """Suspend *Write at Once* while several fields are set."""
    at_once, state.at_once = state.at_once, False
    try:
        yield
    finally:
        state.at_once = at_once


def call_on_change(re_extrapolate: Callable[[list[bpy.types.Object]], object] | None) -> None:
    """Set the function that `write_at_once` calls with a list of anchors, or None."""
    global _re_extrapolate
    _re_extrapolate = re_extrapolate


def _vector(name: str):
    """Property options with getter and setter of a vector in Blender's units."""
    power = VECTORS[name].per_time

    def read(state):
        factor = units_per_second(state) ** power
        return [factor * value for value in getattr(state, f"stored_{name}")]

    def write(state, values):
        factor = units_per_second(state) ** power
        state.clamped = ""
        setattr(state, f"stored_{name}", [value / factor for value in values])

    return {"get": read, "set": write, "size": 3, "update": write_at_once, "options": set()}


def _scalar(name: str, unit: float = 1.0, most: float = math.inf):
    """Property options with getter and setter of a number >= 0 in Blender's units, in multiples of ``unit``."""
    power = models.SCALARS[name].per_time

    def read(state):
        return getattr(state, f"stored_{name}") * units_per_second(state) ** power / unit

    def write(state, value):
        used = min(max(value, 0.0), most)
        label = state.bl_rna.properties[name].name
        limits = "numbers >= 0" if most == math.inf else f"numbers from 0 to {most:g}"
        state.clamped = "" if used == value else f"{label}: takes {limits}, so {value:.4g} became {used:g}"
        setattr(state, f"stored_{name}", used * unit / units_per_second(state) ** power)

    return {"get": read, "set": write, "update": write_at_once, "options": set()}


class R5DGS_PG_motion(bpy.types.PropertyGroup):
    """Motion of an anchor past the last observed time."""

    learned: StringProperty(
        name="Learned Motion", description="Motion stored in the scene file, as JSON", options=set()
    )
    taken: StringProperty(
        name="Taken Motion", description="Motion taken from another object, as JSON", options={"HIDDEN"}
    )
    written: StringProperty(name="Written Keys", description="Digest of the last written keys", options={"HIDDEN"})
    frames_per_unit: FloatProperty(name="Frames per Unit", default=60.0, options={"HIDDEN"})
    written_motion: StringProperty(
        name="Written Motion", description="Digest of the motion of the last written keys", options={"HIDDEN"}
    )
    clamped: StringProperty(
        name="Clamped", description="Message about the last entered number if it was out of range", options={"HIDDEN"}
    )
    too_fast: BoolProperty(
        name="Too Fast for Keys",
        description="The motion rotates or swings so fast that keys are exact only at frames",
        options={"HIDDEN"},
    )
    at_once: BoolProperty(name="Write at Once", description="Re-extrapolate whenever a value changes", options=set())
    kind: EnumProperty(
        name="Motion",
        description="Type of motion past the last observed time",
        items=[(name, kind.label, kind.tooltip, models.MENU_NUMBERS[name]) for name, kind in models.KINDS.items()],
        update=write_at_once,
        options=set(),
    )
    stored_pivot: FloatVectorProperty(size=3, options={"HIDDEN"})  # point chosen on an axis, relative to the anchor
    velocity: FloatVectorProperty(
        name="Velocity",
        description="Velocity at the last observed time, per second, along the axes of the parent",
        subtype="VELOCITY",
        **_vector("velocity"),
    )
    acceleration: FloatVectorProperty(
        name="Acceleration",
        description="Change of the velocity, per second squared",
        subtype="ACCELERATION",
        **_vector("acceleration"),
    )
    angular_velocity: FloatVectorProperty(
        name="Spin /s",
        description="Rotation vector per second: its direction is the axis, its length the angle",
        subtype="EULER",
        unit="ROTATION",
        **_vector("angular_velocity"),
    )
    angular_acceleration: FloatVectorProperty(
        name="Spin /s²",
        description="Change of the spin, per second squared",
        subtype="EULER",
        unit="ROTATION",
        **_vector("angular_acceleration"),
    )
    center_offset: FloatVectorProperty(
        name="Center",
        description="Point that the object spins about, relative to the anchor",
        subtype="TRANSLATION",
        unit="LENGTH",
        **_vector("center_offset"),
    )
    frequency: FloatProperty(
        name="Swings /s",
        description="Oscillations per second; 0 for a steady motion",
        **_scalar("frequency", math.tau),
    )
    damping: FloatProperty(
        name="Damping /s",
        description="Decay rate of a swing, or of the velocity under drag, per second",
        **_scalar("damping"),
    )
    stop_time: FloatProperty(
        name="Rests After",
        description="Seconds from the last observed time until the object rests; 0 if it never rests",
        subtype="TIME_ABSOLUTE",
        unit="TIME_ABSOLUTE",
        **_scalar("stop_time"),
    )
    bounce_time: FloatProperty(
        name="Next Bounce",
        description="Seconds from the last observed time until the next bounce",
        subtype="TIME_ABSOLUTE",
        unit="TIME_ABSOLUTE",
        **_scalar("bounce_time"),
    )
    restitution: FloatProperty(
        name="Restitution",
        description="Speed after a bounce as a share of the speed before it",
        subtype="FACTOR",
        soft_max=1.0,
        **_scalar("restitution", most=1.0),
    )
    precession: FloatVectorProperty(
        name="Precession /s",
        description="Rotation vector per second by which the spin axis turns",
        subtype="EULER",
        unit="ROTATION",
        **_vector("precession"),
    )
    second_velocity: FloatVectorProperty(
        name="2nd Velocity",
        description="Velocity of the second swing at the last observed time",
        subtype="VELOCITY",
        **_vector("second_velocity"),
    )
    second_acceleration: FloatVectorProperty(
        name="2nd Acceleration",
        description="Change of the velocity of the second swing",
        subtype="ACCELERATION",
        **_vector("second_acceleration"),
    )
    second_angular_velocity: FloatVectorProperty(
        name="2nd Spin /s",
        description="Spin of the second swing",
        subtype="EULER",
        unit="ROTATION",
        **_vector("second_angular_velocity"),
    )
    second_angular_acceleration: FloatVectorProperty(
        name="2nd Spin /s²",
        description="Change of the spin of the second swing",
        subtype="EULER",
        unit="ROTATION",
        **_vector("second_angular_acceleration"),
    )
    second_frequency: FloatProperty(
        name="2nd Swings /s",
        description="Oscillations of the second swing per second",
        **_scalar("second_frequency", math.tau),
    )
    learned_leader: PointerProperty(type=bpy.types.Object, options={"HIDDEN"})
    tube: PointerProperty(
        name="Confidence",
        description="Helper that shows the uncertainty of the path",
        type=bpy.types.Object,
        options=set(),
    )
    leader: PointerProperty(
        name="Follows",
        description="Anchor whose path this one follows past the last observed time, like a shadow; "
        "empty for its own motion",
        type=bpy.types.Object,
        poll=lambda state, obj: obj.r5dgs.role == "ANCHOR" and obj != state.id_data,
        options=set(),
    )


def _add_rates() -> None:
    """Add the stored value of each rate, and a plain field for a rate that has none above."""
    properties = R5DGS_PG_motion.__annotations__
    for name in models.FIELDS:
        kind, options, access = FloatProperty, {}, _scalar
        if name in VECTORS:
            kind, options, access = FloatVectorProperty, {"size": 3}, _vector
        properties[f"stored_{name}"] = kind(options={"HIDDEN"}, **options)
        properties.setdefault(name, kind(name=name.replace("_", " ").title(), **access(name)))


_add_rates()


def register():
    """Register the property group on objects."""
    bpy.utils.register_class(R5DGS_PG_motion)
    bpy.types.Object.r5dgs_motion = PointerProperty(type=R5DGS_PG_motion)


def unregister():
    """Undo `register`."""
    del bpy.types.Object.r5dgs_motion
    bpy.utils.unregister_class(R5DGS_PG_motion)

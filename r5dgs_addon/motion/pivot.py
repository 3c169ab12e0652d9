"""About which point and axis an anchor turns or swings past t_max, as fields to look at and to edit.

They are another view of `Object.r5dgs_motion`, whose rates they change: nothing else knows of them. Both are along the
axes of the anchor's parent, those of its location; the point is where the curves and the delta transform have it at
t_max, and not an offset from the anchor.
"""

import contextlib

import bpy
import numpy as np
from bpy.props import FloatVectorProperty, PointerProperty
from mathutils import Vector

from ...r5dgs_core import errors
from ...r5dgs_core.motion import rotation_centers
from ...r5dgs_core.motion.models import MotionModel
from . import extrapolate, fcurves, physics

_ON_AXIS = 1e-4  # of a point's distance: rates are float32


def point(anchor: bpy.types.Object) -> np.ndarray | None:
    """The point about which an anchor turns or swings, or None where its motion has none. [3]

    Raises:
        ConfigError: It is no anchor of a loaded scene, or its curves cannot be read.
    """
    found = _offset(anchor)
    return None if found is None else _place(anchor) + found


def axis(anchor: bpy.types.Object) -> np.ndarray | None:
    """Unit vector about which an anchor turns, or None where it does not turn. [3]"""
    model = _model(anchor)
    return None if model is None else rotation_centers.axis(model)


def move(anchor: bpy.types.Object, to: np.ndarray) -> None:
    """Let an anchor turn or swing about another point; nothing is written to its curves yet. [3]

    Raises:
        ConfigError: Its motion has no such point, or its curves cannot be read.
    """
    model, old = _model(anchor), _offset(anchor)
    if model is None or old is None:
        kind = anchor.r5dgs_motion.bl_rna.properties["kind"].enum_items[anchor.r5dgs_motion.kind].name
        raise errors.ConfigError(
            f"{anchor.name}: the motion '{kind}' has no pivot as it is; choose Throw and Spin, give it a spin, or "
            "swings to what slides"
        )
    offset = np.asarray(to, np.float64) - _place(anchor)
    if not np.isfinite(offset).all():
        raise errors.ConfigError(f"{anchor.name}: pivot: expected three finite numbers, found {tuple(to)}")
    _store(anchor, rotation_centers.with_center(model, offset, old))
    anchor.r5dgs_motion.stored_pivot = offset


def turn(anchor: bpy.types.Object, direction: np.ndarray) -> None:
    """Let an anchor turn about an axis of another direction, through the same point and as fast. [3]

    What does not turn, and a direction of no length, is left alone.

    Raises:
        ConfigError: The rates that it would take are too large.
    """
    model = _model(anchor)
    length = float(np.linalg.norm(direction))
    if model is None or rotation_centers.axis(model) is None or not 0 < length < np.inf:
        return
    through = _offset(anchor)
    _store(anchor, rotation_centers.with_axis(model, np.asarray(direction, np.float64), through))
    if through is not None:
        anchor.r5dgs_motion.stored_pivot = through


def to_parent(anchor: bpy.types.Object, place: Vector) -> np.ndarray:
    """A place in the world along the axes of an anchor's parent, those of its location. [3]"""
    if anchor.parent is None:
        return np.array(place, np.float64)
    if anchor.parent_type == "OBJECT":
        frame = anchor.parent.matrix_world @ anchor.matrix_parent_inverse
    else:  # bones and points of meshes
        frame = anchor.matrix_world @ anchor.matrix_basis.inverted_safe()
    return np.array(frame.inverted_safe() @ place, np.float64)


def _place(anchor: bpy.types.Object) -> np.ndarray:
    """Where an anchor is at t_max, along the axes of its parent. [3]"""
    times = extrapolate.times_of(anchor)
    location, _ = fcurves.pose_at(anchor, fcurves.place(anchor), times.frame(times.t_max))
    return location + np.array(anchor.delta_location, np.float64)


def _model(anchor: bpy.types.Object) -> MotionModel | None:
    """The rates that the fields hold, as a motion; None where they are none, or it tumbles freely or follows."""
    state = anchor.r5dgs_motion
    if state.kind == "free_top" or state.leader is not None:
        return None
    rates = {name: getattr(state, f"stored_{name}") for name in physics.RATES}
    try:
        return MotionModel(state.kind, frequency=state.stored_frequency, **rates)
    except ValueError:  # numbers that are none
        return None


def _offset(anchor: bpy.types.Object) -> np.ndarray | None:
    """The point about which an anchor turns, seen from it. [3]

    Any point of the axis of a screw or an orbit is one: it is the one that was chosen, if the axis still goes through
    that, else the one nearest to the anchor.
    """
    model = _model(anchor)
    found = None if model is None else rotation_centers.center(model)
    if model is None or found is None or model.kind in ("ballistic_spin", "translation"):
        return found
    along = rotation_centers.axis(model)
    assert along is not None  # what has a center and is no spring turns
    chosen = np.array(anchor.r5dgs_motion.stored_pivot, np.float64)
    on_axis = found + along * (along @ chosen)
    return on_axis if np.linalg.norm(on_axis - chosen) <= _ON_AXIS * np.linalg.norm(chosen) else found


def _store(anchor: bpy.types.Object, model: MotionModel) -> None:
    """Set the rates of an anchor; those that stay keep their bits. ConfigError where one is too large to be kept."""
    state = anchor.r5dgs_motion
    with np.errstate(over="ignore"):
        values = {name: getattr(model, name).astype(np.float32) for name in physics.RATES}
    if not all(np.isfinite(value).all() for value in values.values()):
        raise errors.ConfigError(f"{anchor.name}: the pivot lies too far off for so fast a spin")
    for name, value in values.items():
        if (value != np.array(getattr(state, f"stored_{name}"), np.float32)).any():
            setattr(state, f"stored_{name}", value)


def _read_point(state):
    with contextlib.suppress(errors.R5dgsError):  # the panel says why, and shows no pivot
        found = point(state.id_data)
        if found is not None:
            return found
    return np.zeros(3)


def _write_point(state, value):
    with contextlib.suppress(errors.R5dgsError):
        move(state.id_data, value)


def _read_axis(state):
    found = axis(state.id_data)
    return np.zeros(3) if found is None else found


def _write_axis(state, value):
    with contextlib.suppress(errors.R5dgsError):
        turn(state.id_data, value)


def _write_at_once(state, context):
    physics.write_at_once(state.id_data.r5dgs_motion, context)


class R5DGS_PG_pivot(bpy.types.PropertyGroup):
    """The point and the axis about which an anchor turns or swings past t_max."""

    point: FloatVectorProperty(
        name="Pivot",
        description="The point that the object turns or swings about, where it lies at the last observed time; it "
        "flies along where the object is thrown. Along the axes of the parent, as the location is",
        size=3,
        subtype="TRANSLATION",
        unit="LENGTH",
        get=_read_point,
        set=_write_point,
        update=_write_at_once,
        options=set(),
    )
    axis: FloatVectorProperty(
        name="Axis",
        description="The direction that the object turns about; another one keeps pivot and speed",
        size=3,
        subtype="XYZ",
        get=_read_axis,
        set=_write_axis,
        update=_write_at_once,
        options=set(),
    )


def register():
    """Register the group and hang it on objects."""
    bpy.utils.register_class(R5DGS_PG_pivot)
    bpy.types.Object.r5dgs_pivot = PointerProperty(type=R5DGS_PG_pivot)


def unregister():
    """Undo `register`."""
    del bpy.types.Object.r5dgs_pivot
    bpy.utils.unregister_class(R5DGS_PG_pivot)

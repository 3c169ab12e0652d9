"""Pivot and axis of an anchor's rotation or oscillation past t_max, as editable properties.

They are a view of the rates in `Object.r5dgs_motion`. Both are in the axes of the anchor's parent, like its location.
The pivot is the position at t_max according to curves and delta transform, not an offset from the anchor.
"""

import contextlib

import bpy
import numpy as np
from bpy.props import FloatVectorProperty, PointerProperty
from mathutils import Vector

from ...r5dgs_core import errors
from ...r5dgs_core.motion import rotation_centers
from ...r5dgs_core.motion.models import KINDS, MotionModel
from . import curve_place, extrapolate, fcurves, motion_fields, physics

_ON_AXIS = 1e-4  # tolerance as a fraction of the point's distance, because rates are float32


def point(anchor: bpy.types.Object) -> np.ndarray | None:
    """Point that an anchor turns or swings about, or None if its motion has none. [3]

    Raises:
        ConfigError: The object is no anchor of a loaded scene, or its curves cannot be read.
    """
    found = _offset(anchor)
    return None if found is None else _place(anchor) + found


def axis(anchor: bpy.types.Object) -> np.ndarray | None:
    """Unit axis that an anchor turns about, or None if it does not turn. [3]"""
    model = _model(anchor)
    return None if model is None else rotation_centers.axis(model)


def move(anchor: bpy.types.Object, to: np.ndarray) -> None:
    """Change the point that an anchor turns or swings about, without writing its curves. to [3]

    Raises:
        ConfigError: The motion has no such point, or the curves cannot be read.
    """
    model, old = _model(anchor), _offset(anchor)
    if model is None or old is None:
        kind = anchor.r5dgs_motion.bl_rna.properties["kind"].enum_items[anchor.r5dgs_motion.kind].name
        raise errors.ConfigError(
            f"{anchor.name}: the motion '{kind}' has no pivot; choose Throw and Spin, set a spin, or set Swings for "
            "Slide"
        )
    offset = np.asarray(to, np.float64) - _place(anchor)
    if not np.isfinite(offset).all():
        raise errors.ConfigError(f"{anchor.name}: pivot: expected three finite numbers, found {tuple(to)}")
    _store(anchor, rotation_centers.with_center(model, offset, old))
    anchor.r5dgs_motion.stored_pivot = offset


def turn(anchor: bpy.types.Object, direction: np.ndarray) -> None:
    """Change the direction of an anchor's axis; pivot and speed are kept. direction [3]

    Does nothing if the anchor does not turn or the direction is zero.

    Raises:
        ConfigError: The resulting rates are too large.
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
    """Convert a world position to the axes of an anchor's parent, the space of its location. [3]"""
    if anchor.parent is None:
        return np.array(place, np.float64)
    if anchor.parent_type == "OBJECT":
        frame = anchor.parent.matrix_world @ anchor.matrix_parent_inverse
    else:  # bones and mesh vertices
        frame = anchor.matrix_world @ anchor.matrix_basis.inverted_safe()
    return np.array(frame.inverted_safe() @ place, np.float64)


def _place(anchor: bpy.types.Object) -> np.ndarray:
    """Position of an anchor at t_max in the axes of its parent. [3]"""
    times = extrapolate.times_of(anchor)
    location, _ = fcurves.pose_at(anchor, curve_place.find(anchor), times.frame(times.t_max))
    return location + np.array(anchor.delta_location, np.float64)


def _model(anchor: bpy.types.Object) -> MotionModel | None:
    """Motion model of the fields' rates, or None if they are invalid, or if the anchor tumbles or follows another."""
    state = anchor.r5dgs_motion
    if state.leader is not None:
        return None
    try:
        return MotionModel(state.kind, **physics.stored(state))
    except ValueError:  # invalid values, or a kind that needs an inertia
        return None


def _offset(anchor: bpy.types.Object) -> np.ndarray | None:
    """Point that an anchor turns about, relative to the anchor. [3]

    A screw or an orbit turns about every point of its axis: the chosen point is returned if it is still on the axis,
    otherwise the point nearest to the anchor.
    """
    model = _model(anchor)
    found = None if model is None else rotation_centers.center(model)
    if model is None or found is None or not KINDS[model.kind].center_on_axis:
        return found
    along = rotation_centers.axis(model)
    assert along is not None  # the kinds with `center_on_axis` have an axis if they have a centre
    chosen = np.array(anchor.r5dgs_motion.stored_pivot, np.float64)
    on_axis = found + along * (along @ chosen)
    return on_axis if np.linalg.norm(on_axis - chosen) <= _ON_AXIS * np.linalg.norm(chosen) else found


def _store(anchor: bpy.types.Object, model: MotionModel) -> None:
    """Store the rates of an anchor; unchanged ones keep their bits. Raises ConfigError if one overflows."""
    state = anchor.r5dgs_motion
    with np.errstate(over="ignore"):
        values = {name: getattr(model, name).astype(np.float32) for name in physics.RATES}
    if not all(np.isfinite(value).all() for value in values.values()):
        raise errors.ConfigError(f"{anchor.name}: the pivot is too far away for this spin; lower the spin")
    for name, value in values.items():
        if (value != np.array(getattr(state, f"stored_{name}"), np.float32)).any():
            setattr(state, f"stored_{name}", value)


def _read_point(state):
    with contextlib.suppress(errors.R5dgsError):  # shown in the panel
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
    motion_fields.write_at_once(state.id_data.r5dgs_motion, context)


class R5DGS_PG_pivot(bpy.types.PropertyGroup):
    """Pivot and axis of an anchor's motion past t_max."""

    point: FloatVectorProperty(
        name="Pivot",
        description="Point that the object turns or swings about, at its position at the last observed time, "
        "in the axes of the parent; it moves along if the object is thrown",
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
        description="Axis that the object turns about; changing it keeps pivot and speed",
        size=3,
        subtype="XYZ",
        get=_read_axis,
        set=_write_axis,
        update=_write_at_once,
        options=set(),
    )


def register():
    """Register the property group on objects."""
    bpy.utils.register_class(R5DGS_PG_pivot)
    bpy.types.Object.r5dgs_pivot = PointerProperty(type=R5DGS_PG_pivot)


def unregister():
    """Undo `register`."""
    del bpy.types.Object.r5dgs_pivot
    bpy.utils.unregister_class(R5DGS_PG_pivot)

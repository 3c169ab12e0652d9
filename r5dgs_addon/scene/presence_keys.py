"""Keys that hide point clouds in viewports and renders while their motion group is absent from the scene.

Blender overwrites hide flags with the values of keys. An object with such keys is therefore hidden in renders for other
reasons by muting them.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np

from ...r5dgs_core.scene import presence
from ...r5dgs_core.scene.scene import MotionGroup
from .. import compat
from . import retiming, timeline

VIEWPORT, RENDER = "hide_viewport", "hide_render"


def write(cloud: bpy.types.Object, group: MotionGroup, times: timeline.Times) -> None:
    """Key the visibility of a new point cloud; one whose group is never absent gets no keys."""
    if not group.absent:
        return
    edges = (t for interval in group.absent for t in interval if times.t_start < t < np.inf)
    keys = [(times.frame(t), float(presence.is_absent(group.absent, t))) for t in (times.t_start, *edges)]
    fcurves = compat.own_fcurves(cloud, cloud.name)
    for path in (VIEWPORT, RENDER):
        curve = fcurves.new(path)
        for frame, value in keys:
            curve.keyframe_points.insert(frame, value, options={"FAST"}).interpolation = "CONSTANT"
        curve.update()


def curve_of(obj: bpy.types.Object, path: str) -> bpy.types.FCurve | None:
    """F-curve of a hide flag in the active action of an object or in the strip that retimes it, or None."""
    strip = retiming.strip_of(obj)
    if strip is not None:
        found = () if strip.action is None else compat.channels(strip.action, compat.slot_of(strip))
    else:
        found = compat.fcurves(obj)
    return next((curve for curve in found if curve.data_path == path and len(curve.keyframe_points)), None)


def is_keyed(obj: bpy.types.Object) -> bool:
    """True if an object has keys of its visibility."""
    return any(curve_of(obj, path) is not None for path in (VIEWPORT, RENDER))


def absent_at(obj: bpy.types.Object, frames: Sequence[float]) -> np.ndarray:
    """Frames at which the keys of an object hide it in renders; none without keys or if users muted them. [T] bool"""
    curve = curve_of(obj, RENDER)
    if curve is None or (curve.mute and not obj.hide_render):  # `hide_in_renders` mutes and hides
        return np.zeros(len(frames), bool)
    return np.array([curve.evaluate(_own_frame(obj, frame)) > 0.5 for frame in frames], bool)


def is_hidden_in_renders(obj: bpy.types.Object) -> bool:
    """True if an object is hidden in renders, for other reasons than its keys."""
    curve = curve_of(obj, RENDER)
    return obj.hide_render and (curve is None or curve.mute)


def hide_in_renders(obj: bpy.types.Object, hide: bool) -> None:
    """Hide an object in renders, or show it at the frames at which its keys do."""
    curve = curve_of(obj, RENDER)
    if curve is not None and curve.mute != hide:
        curve = _own_curve(obj)
        curve.mute = hide
    keyed = curve is not None and not hide
    obj.hide_render = curve.evaluate(_own_frame(obj, bpy.context.scene.frame_current_final)) > 0.5 if keyed else hide


def follow(obj: bpy.types.Object, leader: bpy.types.Object) -> None:
    """Hide a new object by drivers when an object with keys is hidden; leaders without keys change nothing."""
    for path in (VIEWPORT, RENDER) if is_keyed(leader) else ():
        driver = obj.driver_add(path).driver
        driver.type = "SUM"
        variable = driver.variables.new()
        variable.targets[0].id, variable.targets[0].data_path = leader, path


@contextmanager
def ignored(objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Show objects in viewports at all frames, as Blender does not evaluate hidden ones."""
    found = [(obj, curve) for obj in objects if obj.library is None and (curve := curve_of(obj, VIEWPORT)) is not None]
    before = [(obj.hide_viewport, curve.mute) for obj, curve in found]
    try:
        for obj, curve in found:
            obj.hide_viewport, curve.mute = obj.hide_viewport and curve.mute, True
        yield
    finally:
        for (obj, curve), (hidden, mute) in zip(found, before, strict=True):
            obj.hide_viewport, curve.mute = hidden, mute


def _own_curve(obj: bpy.types.Object) -> bpy.types.FCurve:
    """Curve of an object's visibility in renders, in an action that no other object uses."""
    animation, strip = obj.animation_data, retiming.strip_of(obj)
    user = animation if strip is None else strip
    if user.action.users - user.action.use_fake_user > 1:
        slot = compat.slot_of(user)
        user.action = user.action.copy()
        compat.choose_slot(user, slot)
    curve = curve_of(obj, RENDER)
    assert curve is not None
    return curve


def _own_frame(obj: bpy.types.Object, frame: float) -> float:
    """Frame of an object's keys that Blender shows at a frame."""
    strip = retiming.strip_of(obj)
    curve = None if strip is None else retiming.curve_of(strip)
    return frame if curve is None else curve.evaluate(frame)

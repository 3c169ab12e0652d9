"""Retimed objects: the frame of an object's own motion that Blender shows at a frame.

A retimed anchor plays its action as an NLA strip with animated time, so Blender itself moves it. The curve of the strip
gives the frame of the action at each frame.
"""

import bpy


def strip_of(anchor: bpy.types.Object | None) -> bpy.types.NlaStrip | None:
    """NLA strip that retimes an anchor, or None."""
    animation = None if anchor is None else anchor.animation_data
    if animation is None or not animation.use_nla:
        return None
    strips = (one for track in animation.nla_tracks if not track.mute for one in track.strips if not one.mute)
    return next((one for one in strips if one.use_animated_time and curve_of(one) is not None), None)


def curve_of(strip: bpy.types.NlaStrip) -> bpy.types.FCurve | None:
    """Curve of a strip's animated time, or None if it has no keys."""
    curve = strip.fcurves.find("strip_time")
    return curve if curve is not None and len(curve.keyframe_points) else None


def source_frame(obj: bpy.types.Object, frame: float) -> float:
    """Frame of the motion that an anchor or point cloud shows at a frame."""
    strip = strip_of(obj if obj.r5dgs.role == "ANCHOR" else obj.parent)
    curve = None if strip is None else curve_of(strip)
    return frame if curve is None else curve.evaluate(frame)

"""Frame range of an export or a capture, and drawing of export options."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

FRAMES = (
    ("CURRENT", "This Frame", "The frame that is shown"),
    ("RANGE", "Frame Range", "Every frame of the scene's range, numbered"),
)


def draw_properties(operator, *names: str) -> None:
    """Draw the properties of an export; the frame step only for a frame range."""
    layout = operator.layout
    layout.use_property_split = True
    layout.use_property_decorate = False
    for name in names:
        if name != "frame_step" or operator.frames == "RANGE":
            layout.prop(operator, name)


@contextmanager
def frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Restore a scene's current frame and sub-frame on exit."""
    frame, subframe = scene.frame_current, scene.frame_subframe
    try:
        yield
    finally:
        if (scene.frame_current, scene.frame_subframe) != (frame, subframe):
            scene.frame_set(frame, subframe=subframe)


def frames_of(scene: bpy.types.Scene, every: bool, step: int = 1) -> list[int]:
    """Frames of a scene's range, or only the current one."""
    return list(range(scene.frame_start, scene.frame_end + 1, max(step, 1))) if every else [scene.frame_current]


def go_to(scene: bpy.types.Scene, frame: int) -> None:
    """Go to a whole frame. If it is the current one, keep its sub-frame and edits without keyframes."""
    if frame != scene.frame_current:
        scene.frame_set(frame)

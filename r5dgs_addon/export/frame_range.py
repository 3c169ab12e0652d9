"""The frames that an export or a capture goes through, and how the options of exports are drawn."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

FRAMES = (
    ("CURRENT", "This Frame", "The frame that is shown"),
    ("RANGE", "Frame Range", "Every frame of the scene's range, numbered"),
)


def draw_properties(operator, *names: str) -> None:
    """Draw properties of an export; the frame step where there is a range alone."""
    layout = operator.layout
    layout.use_property_split = True
    layout.use_property_decorate = False
    for name in names:
        if name != "frame_step" or operator.frames == "RANGE":
            layout.prop(operator, name)


@contextmanager
def frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Bring a Blender scene back to the frame where it was, sub-frame included."""
    frame, subframe = scene.frame_current, scene.frame_subframe
    try:
        yield
    finally:
        if (scene.frame_current, scene.frame_subframe) != (frame, subframe):
            scene.frame_set(frame, subframe=subframe)


def frames_of(scene: bpy.types.Scene, every: bool, step: int = 1) -> list[int]:
    """The frames of a Blender scene's range, or the current one alone."""
    return list(range(scene.frame_start, scene.frame_end + 1, max(step, 1))) if every else [scene.frame_current]


def go_to(scene: bpy.types.Scene, frame: int) -> None:
    """Show a whole frame; the current one keeps its sub-frame, and edits that no key holds."""
    if frame != scene.frame_current:
        scene.frame_set(frame)


def numbered(path, frame: int):
    """The path of one frame of a sequence: scene.ply -> scene_0012.ply."""
    return path.with_name(f"{path.stem}_{frame:04d}{path.suffix}")

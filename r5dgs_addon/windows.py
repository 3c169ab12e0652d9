"""What Blender's windows are told: words in the status bar, and that an area is to be drawn anew."""

import bpy


def say(context: bpy.types.Context, text: str | None) -> None:
    """Show words in the status bar; None takes them away."""
    if context.workspace is not None:
        context.workspace.status_text_set(text)


def redraw(*kinds: str) -> None:
    """Have areas of some types drawn anew, of all where none is named."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if not kinds or area.type in kinds:
                area.tag_redraw()

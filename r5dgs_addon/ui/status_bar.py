"""What Blender's windows are told: words in the status bar, and that an area is to be drawn anew."""

import textwrap

import bpy

_LETTER, _MARGIN, _WIDTH = 7, 70, 400  # pixels of a letter, beside a text, and of a region if there is none


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


def wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """Draw a text in lines that fit the region; Blender cuts the middle out of a longer label."""
    width = context.region.width if context.region is not None else _WIDTH
    scale = context.preferences.system.ui_scale or 1.0  # 0 without a window
    letters = max(int((width / scale - _MARGIN) / _LETTER), 20)
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(text, letters)):
        column.label(text=line, icon="BLANK1" if number else icon)

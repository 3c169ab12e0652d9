"""Status bar text, area redraws and wrapped labels."""

import textwrap

import bpy

_LETTER, _MARGIN, _WIDTH = 7, 70, 400  # pixels: letter width, margins beside the text, default region width


def show(context: bpy.types.Context, text: str | None) -> None:
    """Show a text in the status bar, or clear it if None."""
    if context.workspace is not None:
        context.workspace.status_text_set(text)


def redraw(*kinds: str) -> None:
    """Redraw all areas of the given types, or all areas if none is given."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if not kinds or area.type in kinds:
                area.tag_redraw()


def wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """Draw a text in lines that fit the region, because Blender truncates long labels in the middle."""
    width = context.region.width if context.region is not None else _WIDTH
    scale = context.preferences.system.ui_scale or 1.0  # 0 without a window
    letters = max(int((width / scale - _MARGIN) / _LETTER), 20)
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(text, letters)):
        column.label(text=line, icon="BLANK1" if number else icon)

"""Temporary changes to the user's data, undone at the end, even after an error."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import bpy


class Overrides(ExitStack):
    """Context manager that restores all changed attributes on exit, in reverse order."""

    def set(self, owner: Any, name: str, value: Any) -> None:
        """Set ``owner.name`` until the context exits. Does nothing if this Blender version lacks the attribute."""
        if not hasattr(owner, name):
            return
        self.callback(setattr, owner, name, getattr(owner, name))
        setattr(owner, name, value)

    def keep_image_format(self, settings: bpy.types.ImageFormatSettings) -> None:
        """Restore a scene's output format on exit, in a fixed order: earlier settings limit later ones."""
        names = (
            *("media_type", "file_format", "color_mode", "color_depth"),
            *("compression", "exr_codec", "color_management"),
        )
        old = {name: getattr(settings, name) for name in names if hasattr(settings, name)}

        def restore() -> None:
            for name, value in old.items():
                setattr(settings, name, value)

        self.callback(restore)

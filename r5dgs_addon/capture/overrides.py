"""Changes to the user's data that are undone in the end, also after an error."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import bpy


class Overrides(ExitStack):
    """A context in which attributes are changed for a while; leaving it puts all of them back, the latest first."""

    def set(self, owner: Any, name: str, value: Any) -> None:
        """Set ``owner.name`` until the end. Attributes that this Blender does not have are left out."""
        if not hasattr(owner, name):
            return
        self.callback(setattr, owner, name, getattr(owner, name))
        setattr(owner, name, value)

    def keep_image_format(self, settings: bpy.types.ImageFormatSettings) -> None:
        """Keep a scene's output format; what may be chosen depends on what stands before, so the order is fixed."""
        names = (
            *("media_type", "file_format", "color_mode", "color_depth"),
            *("compression", "exr_codec", "color_management"),
        )
        old = {name: getattr(settings, name) for name in names if hasattr(settings, name)}

        def restore() -> None:
            for name, value in old.items():
                setattr(settings, name, value)

        self.callback(restore)

"""Stage of baking: convex hulls of the objects, for collisions, and for shadows in Blender."""

from __future__ import annotations

import dataclasses

from ..shapes import object_hulls
from .draft import Context, Draft


def apply(draft: Draft, context: Context) -> Draft:
    """Add the hulls to the scene."""
    return dataclasses.replace(draft, scene=dataclasses.replace(draft.scene, hulls=object_hulls.of(draft.scene)))

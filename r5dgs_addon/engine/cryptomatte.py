"""Object Cryptomatte: soft masks of the point clouds, picked by name in the compositor.

Each pass holds two ranks per pixel as identity and coverage. The names are stored in the render result's metadata.
"""

from typing import Any

import bpy
import numpy as np

from ...r5dgs_core.formats import cryptomatte
from ...r5dgs_core.protocol import messages
from . import render_request

LAYER = "CryptoObject"
CHANNELS = "rgba"
RANKS = 2  # ranks per pass


def pass_names(view_layer: bpy.types.ViewLayer) -> list[str]:
    """Cryptomatte passes of a view layer, or an empty list if Cryptomatte is off."""
    if not view_layer.use_pass_cryptomatte_object:
        return []
    return [f"{LAYER}{number:02d}" for number in range((view_layer.pass_cryptomatte_depth + 1) // RANKS)]


def names_of(seen: render_request.VisibleParts) -> list[str]:
    """Unique names of the visible point clouds, without hold-outs."""
    return list(dict.fromkeys(instance.object.name for instance in seen.instances if not instance.holdout))


def request(seen: render_request.VisibleParts, passes: int) -> dict[str, Any]:
    """Request arguments for coverage: name index of each instance (-1 for hold-outs) and number of ranks."""
    names = names_of(seen)
    groups = [-1 if one.holdout else names.index(one.object.name) for one in seen.instances]
    return messages.Coverage(groups, RANKS * passes).to_json()


def pixels(arrays: dict[str, np.ndarray], seen: render_request.VisibleParts, number: int) -> np.ndarray:
    """Pixels of a Cryptomatte pass from the worker's arrays, top row first. [H, W, 4] float32"""
    ranks = slice(RANKS * number, RANKS * (number + 1))
    values = np.array([*(cryptomatte.value_of(name) for name in names_of(seen)), 0], np.float32)
    identities, shares = values[arrays["coverage_groups"][..., ranks]], arrays["coverage"][..., ranks]  # -1: none
    return np.stack([identities, shares], axis=-1).reshape(*shares.shape[:2], 2 * RANKS)


def write_names(
    result: bpy.types.RenderResult, view_layer: bpy.types.ViewLayer, seen: render_request.VisibleParts
) -> None:
    """Store the names in the metadata of a render result."""
    for key, text in cryptomatte.metadata(f"{view_layer.name}.{LAYER}", names_of(seen)).items():
        result.stamp_data_add_field(key, text)

"""Passes of the render engine: selection by view layer and conversion from the worker's arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core.color import view_inverse
from ...r5dgs_core.scene import cameras
from .. import compat
from ..color import display_to_linear
from . import cryptomatte, render_request, visible_clouds

NOTHING = 1e10  # depth of empty pixels, as in Blender's own engines
SOLID = 0.5  # minimum alpha of pixels that have a depth and an object


@dataclass(frozen=True)
class Pass:
    """Render pass.

    Attributes:
        name: Blender's name of the pass.
        channels: Channel names, one letter each.
        kind: Type of its compositor socket, COLOR or VALUE.
        worker_array: Array of the worker from which the pass is made; "" for colour.
    """

    name: str
    channels: str
    kind: str
    worker_array: str = ""


COMBINED = Pass("Combined", "RGBA", "COLOR")
DEPTH = Pass("Depth", "Z", "VALUE", "depth")
FRONT = Pass("In Front of Meshes", "RGBA", "COLOR", "front")  # alpha is the visible part of the meshes behind
COLORS = (COMBINED, FRONT)  # passes that depth of field and motion blur apply to
INDEX = Pass(compat.OBJECT_INDEX, "X", "VALUE", "owners")


def of_layer(view_layer: bpy.types.ViewLayer, merged: bool) -> list[Pass]:
    """Passes of a view layer, *Combined* first.

    Args:
        view_layer: The view layer.
        merged: True if meshes are merged with the picture, see `mesh_merge`.
    """
    found = [COMBINED, FRONT] if merged else [COMBINED]
    if view_layer.use_pass_z:
        found.append(DEPTH)
    if view_layer.use_pass_object_index:
        found.append(INDEX)
    names = cryptomatte.pass_names(view_layer)
    return found + [Pass(name, cryptomatte.CHANNELS, "COLOR") for name in names]


def wanted(passes: Sequence[Pass], transparent: bool) -> tuple[str, ...]:
    """Names of the arrays to request from the worker in addition to the colour."""
    names = [one.worker_array for one in passes if one.worker_array and one != FRONT]
    return (*names, "alpha") if transparent or DEPTH in passes else tuple(names)


def pixels(
    one: Pass,
    arrays: dict[str, np.ndarray],
    seen: render_request.VisibleParts,
    transparent: bool,
    inverse: view_inverse.Inverse | None = None,
) -> np.ndarray:
    """Pixels of a pass.

    Args:
        one: The pass.
        arrays: Arrays from the worker, as named by `wanted`.
        seen: Rendered scene.
        transparent: True if the film is transparent.
        inverse: Inverse of the view transform, or None for *Standard*.

    Returns:
        Pixels, top row first. [H, W, channels] float32
    """
    if one == COMBINED:
        return display_to_linear.scene_linear(arrays["color"], alpha(arrays, transparent), inverse)
    if one == FRONT:
        front = display_to_linear.scene_linear(arrays["front"][..., :3], arrays["front"][..., 3], inverse)
        return np.concatenate([front[..., :3], 1 - front[..., 3:]], -1)
    if one == DEPTH:
        return depths(arrays)[..., None]
    if one.name.startswith(cryptomatte.LAYER):
        return cryptomatte.pixels(arrays, seen, int(one.name[len(cryptomatte.LAYER) :]))
    return indices(arrays, seen)[..., None].astype(np.float32)


def alpha(arrays: dict[str, np.ndarray], transparent: bool) -> np.ndarray | None:
    """Alpha of an image, 0 in hold-outs, or None if it is opaque everywhere. [H, W]"""
    if transparent:
        return arrays["alpha"]
    return 1 - arrays["holdout"] if "holdout" in arrays else None


def depths(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Depths from ``alpha`` and ``depth``; `NOTHING` where alpha is below `SOLID`. [H, W] float32"""
    return np.where(arrays["alpha"] >= SOLID, arrays["depth"], np.float32(NOTHING)).astype(np.float32)


def indices(arrays: dict[str, np.ndarray], seen: render_request.VisibleParts) -> np.ndarray:
    """Object indices from ``owners``, 0 for background. [H, W] int64"""
    own = [index_of(instance) for instance in seen.instances]
    return np.array([*own, 0], np.int64)[arrays["owners"]]  # owner -1 (none) selects the last value


def empty(camera: cameras.Camera, ranks: int) -> dict[str, np.ndarray]:
    """Arrays of an empty image with the given number of coverage ranks."""
    size = (camera.height, camera.width)
    return {
        "color": np.zeros((*size, 3), np.float32),
        "alpha": np.zeros(size, np.float32),
        "depth": np.zeros(size, np.float32),
        "owners": np.full(size, -1, np.int32),
        "front": np.zeros((*size, 4), np.float32),
        "coverage": np.zeros((*size, ranks), np.float32),
        "coverage_groups": np.full((*size, ranks), -1, np.int32),
    }


def index_of(instance: visible_clouds.VisibleCloud) -> int:
    """Object index of a point cloud: the user's *Pass Index* if set, otherwise its object id."""
    makers = [instance.object] if instance.parent is None else [instance.parent, instance.object]
    indices = [maker.pass_index for maker in makers if maker.pass_index]
    return indices[0] if indices else max(instance.object.r5dgs.object_id, 0)


def fill(layer: bpy.types.RenderLayer, arrays: dict[str, np.ndarray]) -> None:
    """Write all passes of a render layer in one call, which is far faster than one call per pass.

    Args:
        layer: Layer of a render result.
        arrays: Pixels by pass name, top row first; other passes stay black. [H, W, channels]
    """
    height, width = arrays[COMBINED.name].shape[:2]
    parts = []
    for one in layer.passes:
        rows = arrays.get(one.name)
        rows = np.zeros((height, width, one.channels), np.float32) if rows is None else rows[::-1]
        parts.append(np.ascontiguousarray(rows, np.float32).ravel())
    layer.passes.foreach_set("rect", np.concatenate(parts))

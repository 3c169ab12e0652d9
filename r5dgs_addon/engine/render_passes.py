"""The passes of the render engine: which a view layer asks for, and what the worker's arrays are in each."""

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core.color import view_inverse
from ...r5dgs_core.scene import cameras
from .. import compat
from ..color import display_to_linear
from . import cryptomatte, render_request, visible_clouds

NOTHING = 1e10  # depth where there is nothing, as Blender's own engines write it
SOLID = 0.5  # alpha from which on a pixel has a depth and an object


@dataclass(frozen=True)
class Pass:
    """One pass of a render result.

    Attributes:
        name: Blender's name of it.
        channels: Their names, one letter each.
        kind: Of its socket in the compositor: COLOR or VALUE.
        want: The worker's array that it is made of; empty for the colour.
    """

    name: str
    channels: str
    kind: str
    want: str = ""


COMBINED = Pass("Combined", "RGBA", "COLOR")
DEPTH = Pass("Depth", "Z", "VALUE", "depth")
INDEX = Pass(compat.OBJECT_INDEX, "X", "VALUE", "owners")


def of_layer(view_layer: bpy.types.ViewLayer) -> list[Pass]:
    """The passes that a view layer asks for, *Combined* first."""
    found = [COMBINED]
    if view_layer.use_pass_z:
        found.append(DEPTH)
    if view_layer.use_pass_object_index:
        found.append(INDEX)
    names = cryptomatte.pass_names(view_layer)
    return found + [Pass(name, cryptomatte.CHANNELS, "COLOR") for name in names]


def wanted(passes: Sequence[Pass], transparent: bool) -> tuple[str, ...]:
    """The arrays to ask the worker for, beside the colour."""
    names = [one.want for one in passes if one.want]
    return (*names, "alpha") if transparent or DEPTH in passes else tuple(names)


def pixels(
    one: Pass,
    arrays: dict[str, np.ndarray],
    seen: render_request.Shown,
    transparent: bool,
    inverse: view_inverse.Inverse | None = None,
) -> np.ndarray:
    """What a pass holds.

    Args:
        one: The pass.
        arrays: The worker's answer, of what `wanted` names.
        seen: What was rendered.
        transparent: Whether the film is.
        inverse: Of the view transform; of *Standard* where None.

    Returns:
        Rows from the top. [H, W, channels] float32
    """
    if one == COMBINED:
        return display_to_linear.scene_linear(arrays["color"], alpha(arrays, transparent), inverse)
    if one == DEPTH:
        return depths(arrays)[..., None]
    if one.name.startswith(cryptomatte.LAYER):
        return cryptomatte.pixels(arrays, seen, int(one.name[len(cryptomatte.LAYER) :]))
    return indices(arrays, seen)[..., None].astype(np.float32)


def alpha(arrays: dict[str, np.ndarray], transparent: bool) -> np.ndarray | None:
    """Alpha of a picture, 0 in hold-outs, or None if it is opaque everywhere. [H, W]"""
    if transparent:
        return arrays["alpha"]
    return 1 - arrays["holdout"] if "holdout" in arrays else None


def depths(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Depths of a picture with ``alpha`` and ``depth``, `NOTHING` where it is not solid. [H, W] float32"""
    return np.where(arrays["alpha"] >= SOLID, arrays["depth"], np.float32(NOTHING)).astype(np.float32)


def indices(arrays: dict[str, np.ndarray], seen: render_request.Shown) -> np.ndarray:
    """Object indices of a picture with ``owners``, 0 where nothing is in front. [H, W] int64"""
    own = [index_of(instance) for instance in seen.instances]
    return np.array([*own, 0], np.int64)[arrays["owners"]]  # none is -1, the last


def empty(camera: cameras.Camera, ranks: int) -> dict[str, np.ndarray]:
    """The worker's arrays of a picture of nothing, with as many ranks of coverage."""
    size = (camera.height, camera.width)
    return {
        "color": np.zeros((*size, 3), np.float32),
        "alpha": np.zeros(size, np.float32),
        "depth": np.zeros(size, np.float32),
        "owners": np.full(size, -1, np.int32),
        "coverage": np.zeros((*size, ranks), np.float32),
        "coverage_groups": np.full((*size, ranks), -1, np.int32),
    }


def index_of(instance: visible_clouds.Instance) -> int:
    """Object index of a cloud: the user's *Pass Index* where one is set, else the id of the scene's table."""
    makers = [instance.object] if instance.parent is None else [instance.parent, instance.object]
    indices = [maker.pass_index for maker in makers if maker.pass_index]
    return indices[0] if indices else max(instance.object.r5dgs.object_id, 0)


def fill(layer: bpy.types.RenderLayer, arrays: dict[str, np.ndarray]) -> None:
    """Write passes of a render layer in one go, which is far faster than one by one.

    Args:
        layer: Of a render result.
        arrays: Rows from the top, by name of the pass; passes without one stay black. [H, W, channels]
    """
    height, width = arrays[COMBINED.name].shape[:2]
    parts = []
    for one in layer.passes:
        rows = arrays.get(one.name)
        rows = np.zeros((height, width, one.channels), np.float32) if rows is None else rows[::-1]
        parts.append(np.ascontiguousarray(rows, np.float32).ravel())
    layer.passes.foreach_set("rect", np.concatenate(parts))

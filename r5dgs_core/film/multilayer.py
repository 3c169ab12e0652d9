"""Multilayer OpenEXR pictures: colour, depth, object index, alpha and Cryptomatte, with Blender's names of channels.

Colours are linear with premultiplied alpha, as compositors expect of EXR; the straight display-referred colour is
linearised before it is premultiplied, so that dividing by alpha restores the blended colours.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from ..color import srgb
from ..data import images
from ..formats import cryptomatte
from ..scene.scene import Scene
from .frame_renderer import RANKS, Layers

LAYER = "ViewLayer"
MATTE = "CryptoObject"
RANKS_PER_PASS = 2


def channels(
    scene: Scene, picture: np.ndarray, layers: Layers | None, passes: Collection[str]
) -> dict[str, np.ndarray]:
    """Return the channels of a file by name, in the order of the file. [H, W] float32 each

    Args:
        scene: The scene, for the names of its objects.
        picture: Result of `FrameRenderer.picture`. [H, W, 4]
        layers: Result of `FrameRenderer.layers`; None if there are no passes.
        passes: Names of `settings.PASSES`.
    """
    linear = srgb.to_linear(picture[..., :3]) * picture[..., 3:]
    found = {f"Combined.{name}": linear[..., k] for k, name in enumerate("RGB")} | {"Combined.A": picture[..., 3]}
    if layers is not None:
        if "depth" in passes:
            found["Depth.Z"] = layers.depth
        if "index" in passes:
            found["IndexOB.X"] = layers.index
        if "alpha" in passes:
            found["Alpha.V"] = layers.alpha
        if "cryptomatte" in passes:
            found |= _matte(scene, layers)
    return {f"{LAYER}.{name}": np.asarray(values, np.float32) for name, values in found.items()}


def write(path: Path, found: dict[str, np.ndarray], scene: Scene) -> None:
    """Write channels to a file atomically. Raises DatasetError if it cannot be written."""
    header = {}
    if any(MATTE in name for name in found):
        header = cryptomatte.metadata(f"{LAYER}.{MATTE}", [item.name for item in scene.objects])
    images.write_exr(path, found, dict(header))


def _matte(scene: Scene, layers: Layers) -> dict[str, np.ndarray]:
    """Return Cryptomatte channels: identity and share of the objects of each pixel, two objects per pass."""
    values = np.zeros(max(item.id for item in scene.objects) + 2, np.float32)  # the last is for id -1
    for item in scene.objects:
        if item.id >= 0:
            values[item.id] = cryptomatte.value_of(item.name)
    found = {}
    for rank in range(RANKS):
        first, second = "RG" if rank % RANKS_PER_PASS == 0 else "BA"
        name = f"{MATTE}{rank // RANKS_PER_PASS:02d}"
        found[f"{name}.{first}"] = values[layers.objects[..., rank]]
        found[f"{name}.{second}"] = layers.shares[..., rank]
    return found

"""Pictures of selected objects: isolated on transparency, or highlighted in the dimmed scene.

Objects are selected by id. An isolated object also shows the parts that other objects occlude.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np

from ..playback import scene_player
from ..scene import presence
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import scene_renderer

DIMMED = 0.3  # brightness factor of unselected objects, which also lose their colour
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # Rec. 601, for display-referred colours


def isolate(
    scene: Scene,
    object_ids: Collection[int],
    camera: Camera,
    t: float,
    mode: str = "rigid",
    *,
    backend: str = "auto",
) -> np.ndarray:
    """Render some objects alone.

    Args:
        scene: The scene.
        object_ids: The objects.
        camera: The camera, in the scene's world.
        t: Scene time, may exceed t_max.
        mode: Playback mode past t_max.
        backend: Rasterizer.

    Returns:
        Display-referred sRGB and straight alpha, in [0, 1]; black if alpha is 0. [H, W, 4] float32
    """
    frame = scene_player.Player(scene, mode).frame(t, origin=camera.center)
    alone = without_others(frame, object_ids)
    output = scene_renderer.render_frame(scene, alone, camera, background=None, backend=backend)
    color = output.color  # premultiplied: blended over black
    alpha = np.clip(output.alpha, 0, 1)[..., None]
    straight = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 1e-6)
    return np.concatenate([np.clip(straight, 0, 1), alpha], axis=-1)


def without_others(frame: scene_player.Frame, object_ids: Collection[int]) -> scene_player.Frame:
    """Return a frame in which the Gaussians of all other objects are invisible."""
    wanted = np.isin(frame.object_ids, list(object_ids))
    logits = np.where(wanted, frame.opacity_logits, np.float32(presence.HIDDEN)).astype(np.float32)
    return dataclasses.replace(frame, opacity_logits=logits)


def highlight(
    scene: Scene,
    object_ids: Collection[int],
    camera: Camera,
    t: float,
    mode: str = "rigid",
    *,
    backend: str = "auto",
) -> np.ndarray:
    """Render the whole scene, dark and gray except for some objects.

    Each pixel is blended by the objects' share of it, so their edges stay soft. Arguments as in `isolate`.

    Returns:
        Display-referred sRGB in [0, 1]. [H, W, 3] float32
    """
    wanted = np.isin(scene.gaussians.object_ids, list(object_ids)).astype(np.float32)
    player = scene_player.Player(scene, mode)
    output = scene_renderer.render(player, camera, t, backend=backend, features=wanted[:, None])
    color = np.clip(output.color, 0, 1)
    share = np.clip(output.features, 0, 1)
    dark = (DIMMED * (color @ _LUMA))[..., None]
    return (share * color + (1 - share) * dark).astype(np.float32)

"""Pictures of some objects of a scene: alone on transparency, or among the others, which are dimmed.

Whose a Gaussian is decides its label. An object that is alone shows also what other objects hide of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np

from ..playback import scene_player
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import scene_renderer

DIMMED = 0.3  # of its brightness is left to what is not asked for, and none of its colour
_ABSENT = -40.0  # logit of an opacity that nothing sees
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
    """Draw some objects alone.

    Args:
        scene: The scene.
        object_ids: The objects.
        camera: The camera, in the scene's world.
        t: Scene time, past t_max too.
        mode: Way to move past t_max.
        backend: Rasterizer.

    Returns:
        Display-referred sRGB and straight alpha, within [0, 1]; black where alpha is 0. [H, W, 4] float32
    """
    frame = scene_player.frame(scene, t, mode)
    wanted = np.isin(frame.object_ids, list(object_ids))
    alone = dataclasses.replace(
        frame, opacity_logits=np.where(wanted, frame.opacity_logits, np.float32(_ABSENT)).astype(np.float32)
    )
    output = scene_renderer.render_frame(scene, alone, camera, background=None, backend=backend)
    color = scene_renderer.to_numpy(output.color, np.float32)  # over black: alpha is in it
    alpha = np.clip(scene_renderer.to_numpy(output.alpha, np.float32), 0, 1)[..., None]
    straight = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 1e-6)
    return np.concatenate([np.clip(straight, 0, 1), alpha], axis=-1)


def highlight(
    scene: Scene,
    object_ids: Collection[int],
    camera: Camera,
    t: float,
    mode: str = "rigid",
    *,
    backend: str = "auto",
) -> np.ndarray:
    """Draw the whole scene, gray and dark but for some objects.

    A pixel keeps its colour by the share that the objects have in it, so their edges are as soft as they are drawn.
    Arguments as of `isolate`.

    Returns:
        Display-referred sRGB within [0, 1]. [H, W, 3] float32
    """
    frame = scene_player.frame(scene, t, mode)
    wanted = np.isin(frame.object_ids, list(object_ids)).astype(np.float32)
    output = scene_renderer.render_frame(scene, frame, camera, backend=backend, features=wanted[:, None])
    color = np.clip(scene_renderer.to_numpy(output.color, np.float32), 0, 1)
    share = np.clip(scene_renderer.to_numpy(output.features, np.float32), 0, 1)
    dark = (DIMMED * (color @ _LUMA))[..., None]
    return (share * color + (1 - share) * dark).astype(np.float32)

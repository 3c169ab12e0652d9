"""Gaussians of a scene at a time, with rotations and shading applied to their colours."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ..color import tints
from ..scene import presence, spherical_harmonics
from ..scene.scene import Scene
from ..scene.splats import Splats
from . import affine_transform
from .scene_player import Player


def rows_at(scene: Scene, t: float, object_ids: Collection[int] | None = None) -> np.ndarray:
    """Return the rows of the Gaussians of some objects, all if None, that are not absent at a time. [n]"""
    own = scene.gaussians.object_ids
    chosen = np.ones(len(own), bool) if object_ids is None else np.isin(own, list(object_ids))
    gone = presence.absent_rows([group.absent for group in scene.groups], scene.gaussians.motion_ids, t)
    return np.flatnonzero(chosen if gone is None else chosen & ~gone)


def at(player: Player, t: float, object_ids: Collection[int] | None = None) -> Splats:
    """Return the Gaussians at a time as renderers without motion or shading need them, without absent ones.

    Args:
        player: The scene in a playback mode.
        t: Scene time, may exceed t_max.
        object_ids: Objects to include; None for all Gaussians.
    """
    frame, rows = player.frame(t), rows_at(player.scene, t, object_ids)
    bind = affine_transform.bind_state(player.scene, rows)
    sh = bind.sh
    if sh.shape[1] > 1:
        turns = frame.group_quats[frame.motion_ids]
        if frame.turned_rows is not None and frame.turned_quats is not None:
            turns[frame.turned_rows] = frame.turned_quats
        sh = spherical_harmonics.rotate(sh, turns[rows])
    if frame.shading_factor is not None:
        sh = tints.tint_sh(sh, frame.shading_factor[rows, None])
    return Splats(
        means=frame.means[rows],
        quats=frame.quats[rows],
        log_scales=frame.log_scales[rows],
        opacity_logits=frame.opacity_logits[rows],
        sh=sh,
        identities=bind.identities,
        object_ids=bind.object_ids,
    )

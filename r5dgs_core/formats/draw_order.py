"""Origins of meshes for viewers that draw one mesh after the other, those whose origin is farthest away first.

The background surrounds the objects, so no point of it is farther away than all of them. Its origin is moved far along
the mean viewing direction of the captured cameras instead, and that of a shadow half as far: from such sides the
background comes first, then the shadows, then the objects by the places of their anchors.
"""

from __future__ import annotations

import numpy as np

from ..scene.scene import Scene
from .scene_nodes import NodePiece

FAR = 4.0  # distance of the background's origin, in extents of the scene
_LEAST = 0.2  # length of the mean of the viewing directions, below which cameras look from all sides


def origins(scene: Scene, pieces: list[NodePiece]) -> np.ndarray:
    """Origin of the mesh of each piece in the frame of its group's anchor, a multiple of float32. [P, 3]"""
    found, away = np.zeros((len(pieces), 3)), _away(scene)
    for number, (rows, object_id, motion_id) in enumerate(pieces):
        group = scene.groups[motion_id]
        if group.role == "shadow":
            found[number] = 0.5 * away
        elif group.role == "pinned" and object_id > 0:
            found[number] = np.median(scene.gaussians.means[rows], axis=0) - group.home
        elif group.role == "pinned":
            found[number] = away
    return found.astype(np.float32).astype(np.float64)


def _away(scene: Scene) -> np.ndarray:
    """Place of the background's origin; zero if the captured cameras have no common direction. [3]"""
    if not scene.cameras:
        return np.zeros(3)
    mean = np.mean([camera.forward for camera in scene.cameras], axis=0)
    length = float(np.linalg.norm(mean))
    return FAR * scene.extent * mean / length if length > _LEAST else np.zeros(3)

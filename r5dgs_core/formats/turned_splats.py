"""Gaussians in the axes of formats that prescribe them."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..motion import rotations
from ..scene import spherical_harmonics
from ..scene.splats import Splats


def turned(splats: Splats, rotation: np.ndarray) -> Splats:
    """Gaussians in other axes: positions, rotations and harmonics, multiplied by a rotation matrix. [3, 3]"""
    quat = rotations.rotmats_to_quats(rotation)
    quats = rotations.normalize(rotations.multiply(quat, splats.quats.astype(np.float64)))
    sh = splats.sh
    if sh.shape[1] > 1:
        sh = spherical_harmonics.rotate(sh, np.tile(quat, (len(sh), 1)))
    return dataclasses.replace(
        splats,
        means=(splats.means @ rotation.T).astype(np.float32),
        quats=quats.astype(np.float32),
        sh=sh.astype(np.float32),
    )

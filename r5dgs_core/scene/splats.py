"""The `Splats` dataclass, static Gaussians without objects, as in 3DGS PLY files, and their opacities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Splats:
    """Gaussians without objects or motion.

    Attributes:
        means: Centres, in the world of the file or picture. [N, 3] float32
        quats: Unit wxyz. [N, 4] float32
        log_scales: Natural logarithm of the standard deviations. [N, 3] float32
        opacity_logits: Opacities before the sigmoid. [N] float32
        sh: Coefficients, 3DGS convention. [N, K, 3] float32
        identities: Identity encodings, or None. [N, 16] float32
        object_ids: Object of each Gaussian, or None. [N] int32
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    identities: np.ndarray | None = None
    object_ids: np.ndarray | None = None


def to_opacities(logits: np.ndarray) -> np.ndarray:
    """Opacities in [0, 1] of logits. float64"""
    return 1 / (1 + np.exp(-logits.astype(np.float64)))

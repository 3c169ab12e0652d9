"""Parts of a picture of several scenes: transformed ranges of Gaussians, and the sky behind them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Instance:
    """A transformed range of a scene's Gaussians.

    Attributes:
        start: First row.
        count: Number of rows.
        matrix: Affine map from the bind state to the world of the picture. [4, 4]
        scene: Index of the scene.
        world: Map from the scene's own world, which its light is fixed to, to the world of the picture; None for the
            identity. [4, 4]
        tint: Factors >= 0 on display-referred red, green and blue; None for 1.
        t: Scene time at which residuals are applied, before the matrix; None to leave them out.
        holdout: True if the Gaussians cut a hole into the picture instead of being visible.
    """

    start: int
    count: int
    matrix: np.ndarray
    scene: int = 0
    world: np.ndarray | None = None
    tint: tuple[float, float, float] | None = None
    t: float | None = None
    holdout: bool = False


@dataclass(frozen=True)
class Sky:
    """Scene whose sky is the background.

    Attributes:
        scene: Index of the scene.
        matrix: Map from that scene's world to the world of the picture; its translation has no effect. [4, 4]
    """

    scene: int = 0
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))

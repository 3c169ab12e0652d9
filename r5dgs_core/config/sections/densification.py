"""Sections of the densification, one per strategy."""

from __future__ import annotations

from dataclasses import dataclass

STRATEGIES = ("share", "default", "mcmc")


@dataclass(frozen=True)
class DensifySection:
    """Schedule and limits of densification; all keys but ``strategy`` and ``max_gaussians`` apply to ``share`` alone.

    Attributes:
        strategy: ``share`` (in each round, the Gaussians with the largest gradients grow, up to a share of all),
            ``default`` (adaptive density control of 3DGS) or ``mcmc`` (3DGS as Markov Chain Monte Carlo).
        start: First step of densification.
        stop: Last step of densification, as a share of the run.
        every: Steps between two rounds.
        gradient: Mean screen-space gradient above which a Gaussian grows, per half image width (as in 3DGS).
        share: Maximum share of the Gaussians that grow in a round.
        split_pixels: Standard deviation in pixels above which a growing Gaussian is split; smaller ones are cloned.
        max_gaussians: Maximum number of Gaussians. 0 chooses it from the image size (3/4 of an image's pixels, at most
            60000).
        prune_opacity: Opacity below which a Gaussian is removed.
        prune_width: Standard deviation, as a share of the image width, above which a Gaussian is removed.
        prune_near: Distance from a camera below which background Gaussians in the view of fewer than two cameras are
            removed, normalised units (the cameras' focus is at about 4). 0 keeps them.
        opacity: Weight of the mean opacity in the loss, which fades Gaussians that no image needs. 0 turns it off.
    """

    strategy: str = "share"
    start: int = 200
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    share: float = 0.2
    split_pixels: float = 1.0
    max_gaussians: int = 0
    prune_opacity: float = 0.01
    prune_width: float = 0.16
    prune_near: float = 1.0
    opacity: float = 0.003


@dataclass(frozen=True)
class DensifyDefaultSection:
    """Strategy ``default``, with the thresholds of 3DGS, which starts from ``init.opacity`` = 0.1.

    Attributes:
        start: Step after which Gaussians grow.
        stop: Share of the run after which they no longer grow (15000 of 30000 steps).
        every: Steps between two rounds.
        gradient: Minimum mean screen-space gradient at which a Gaussian grows, per half image width.
        percent_dense: Standard deviation, as a share of the cameras' extent, above which a growing Gaussian is split;
            smaller ones are cloned.
        prune_opacity: Opacity below which a Gaussian is removed.
        prune_radius: Radius in a view, px, above which a Gaussian is removed, after the first reset of the opacities.
        prune_extent: Standard deviation, as a share of the cameras' extent, above which a Gaussian is removed, after
            the first reset of the opacities.
        reset_every: Steps between two resets of the opacities while Gaussians grow. 0 turns resets off.
        reset_opacity: Maximum opacity after a reset.
    """

    start: int = 500
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    prune_radius: float = 20.0
    prune_extent: float = 0.1
    reset_every: int = 3000
    reset_opacity: float = 0.01


@dataclass(frozen=True)
class DensifyMcmcSection:
    """Strategy ``mcmc``, with the thresholds of its paper.

    Attributes:
        start: Step after which Gaussians are relocated and added.
        stop: Share of the run after which neither happens (25000 of 30000 steps).
        every: Steps between two rounds.
        grow: Share of the Gaussians that a round adds, up to ``densify.max_gaussians``.
        dead_opacity: Opacity below which a Gaussian is dead; dead Gaussians are relocated onto live ones.
        noise: Scale of the noise on the centres, per variance and learning rate of the centres. 0 turns it off.
        opacity: Weight of the mean opacity in the loss.
        scale: Weight of the mean standard deviation in the loss.
    """

    start: int = 500
    stop: float = 25 / 30
    every: int = 100
    grow: float = 0.05
    dead_opacity: float = 0.005
    noise: float = 5e5
    opacity: float = 0.01
    scale: float = 0.01

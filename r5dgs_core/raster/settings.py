"""Settings, statistics and results of the rasterizer."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from ..scene.cameras import Camera
from .arrays import Array, array_namespace


@dataclass(frozen=True)
class RasterSettings:
    """Thresholds of Gaussian splatting; the defaults are those of 3DGS.

    Attributes:
        near_plane: Gaussians whose centre has a smaller depth are culled, world units.
        dilation: Low-pass filter: variance added along both image axes, px^2. At least 0.01, because rounding errors of
            the exponent grow as Gaussians get thinner, and the float64 margin of the kernels does not cover thinner
            ones.
        frustum_slack: Slopes are clamped to the image border plus this share of half the field of view before the
            projection is linearised: 0.3 means 1.3 times the field of view.
        alpha_min: Contributions below this are dropped.
        alpha_max: Cap on contributions; the gradient of capped contributions is zero.
        transmittance_min: A pixel is finished before the contribution that would reduce its transmittance to this, with
            the defaults the second one at ``alpha_max``; see `finished_at`. At least 1e-30, as pixels are float32.
        id_alpha_min: Pixels with less alpha than this get id -1. In [0, 1].
        exact: Project, cull and sort in float64, and check the values of all inputs. Only backend "cuda" can omit
            this, which is several times faster and never waits for the results; the other backends ignore it.
    """

    near_plane: float = 0.01
    dilation: float = 0.3
    frustum_slack: float = 0.3
    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    id_alpha_min: float = 0.5
    exact: bool = True

    @property
    def finished_at(self) -> float:
        """Lower bound on transmittance: ``transmittance_min`` with a margin for rounding.

        Two capped layers leave (1 - 0.99)^2 = 1e-4, which rounds below 1e-4 in float32 and above it in float64. 3DGS
        and gsplat compute in float32 and stop there, so all backends stop there too.
        """
        return self.transmittance_min * (1 + 1e-6)

    def __post_init__(self):
        for field in fields(self):
            if not math.isfinite(getattr(self, field.name)):
                raise ValueError(
                    f"raster settings: {field.name}: expected a finite number, got {getattr(self, field.name)}"
                )
        bounds = {
            "near_plane": (self.near_plane > 0, "more than 0"),
            "dilation": (self.dilation >= 0.01, "0.01 or more"),
            "frustum_slack": (self.frustum_slack >= 0, "0 or more"),
            "alpha_min": (1e-4 <= self.alpha_min < self.alpha_max, "1e-4 or more, and less than alpha_max"),
            "alpha_max": (self.alpha_max <= 0.999, "at most 0.999"),
            "transmittance_min": (1e-30 <= self.transmittance_min < 1, "1e-30 or more, and less than 1"),
            "id_alpha_min": (0 <= self.id_alpha_min <= 1, "0 to 1"),
        }
        for name, (fits, expected) in bounds.items():
            if not fits:
                raise ValueError(f"raster settings: {name}: expected {expected}, got {getattr(self, name)}")


DRAFT = RasterSettings(exact=False)  # for pictures whose Gaussians change with every step


@dataclass
class RasterStats:
    """Statistics of one call for densification. Pass an empty instance and read it afterwards.

    Attributes:
        visible: True if the Gaussian touches the image; set by the call. [N] bool
        radii: Three standard deviations along the long axis of the projected Gaussian, px, 0 if not visible. [N]
        grad_norm: Norm of the gradient by the projected centre, per px of this view; set by the backward pass, 0 if not
            visible. [N]
        capacity: Given by the caller to backend "cuda" with ``exact=False``: largest number of pairs of Gaussian and
            tile that are drawn, so that nothing waits for their number; 0 for no limit.
        pairs: Number of these pairs before the limit, if ``capacity`` is given; set by the call. [] int64
    """

    visible: Array | None = None
    radii: Array | None = None
    grad_norm: Array | None = None
    capacity: int = 0
    pairs: Array | None = None

    def fill(self, radii: Array) -> None:
        """Set all statistics before a backward pass, from the radii. [N]"""
        self.radii, self.visible = radii, radii > 0
        self.grad_norm = array_namespace(radii).zeros_like(radii)


@dataclass(frozen=True)
class SplatImage:
    """Image of splats with any number of channels.

    Attributes:
        image: Channels blended over the background. [H, W, D]
        alpha: Coverage. [H, W]
        depth: Expected depth z in the camera frame, divided by alpha; 0 if alpha is 0. [H, W]
        ids: Label with the largest weight, -1 if alpha is small; None without labels. [H, W] int32
    """

    image: Array
    alpha: Array
    depth: Array
    ids: Array | None = None


@dataclass(frozen=True)
class RenderOutput:
    """Rendered image of Gaussians.

    Attributes:
        color: Display-referred colour over the background. [H, W, 3]
        alpha: Coverage. [H, W]
        depth: Expected depth z in the camera frame, divided by alpha; 0 if alpha is 0. [H, W]
        features: Features blended over zeros, or None without features. [H, W, F]
        ids: Object with the largest weight, -1 if alpha is small, or None without object ids. [H, W] int32
        holdout: Coverage of hold-outs, which alpha and depth leave out, or None without hold-outs. [H, W]
    """

    color: Array
    alpha: Array
    depth: Array
    features: Array = None
    ids: Array = None
    holdout: Array = None


def frustum_slopes(camera: Camera, settings: RasterSettings) -> tuple[float, float, float, float]:
    """Bounds of x/z (low, high) and y/z (low, high) to which the point of linearisation is clamped."""
    k = camera.intrinsics
    slack_u = settings.frustum_slack * 0.5 * camera.width / k[0, 0]
    slack_v = settings.frustum_slack * 0.5 * camera.height / k[1, 1]
    return (
        float(-k[0, 2] / k[0, 0] - slack_u),
        float((camera.width - k[0, 2]) / k[0, 0] + slack_u),
        float(-k[1, 2] / k[1, 1] - slack_v),
        float((camera.height - k[1, 2]) / k[1, 1] + slack_v),
    )

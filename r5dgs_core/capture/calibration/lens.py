"""Lenses: projection of directions to pixels and back.

Camera axes are OpenCV's (x right, y down, z forward). Pixel coordinates have the centre of the first pixel at (0.5,
0.5). OpenCV and most calibration files count it as 0; `Lens.from_opencv` adds the half pixel.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import distortion
from .distortion import MODELS

_WIDEST = {distortion.TANGENT: math.tan(math.radians(87)), distortion.ANGLES: math.radians(179)}
_RADII, _RAYS = 1024, 32  # samples of the image plane for `_profile`
_NEWTON_STEPS = 12
_SOLVED = 1e-9  # residual at focal length 1


@dataclass(frozen=True)
class Lens:
    """A lens: u = fx a + skew b + cx, v = fy b + cy for the distorted point (a, b) of `distortion`.

    Attributes:
        model: Key of `distortion.MODELS`.
        fx: Focal length in pixels, horizontal.
        fy: Focal length in pixels, vertical.
        cx: Principal point in pixels from the left edge of the image.
        cy: Principal point in pixels from the upper edge of the image.
        coefficients: Coefficients of the model, in its order.
        skew: Skew of the pixels.
    """

    model: str
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()
    skew: float = 0.0

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"unknown lens model {self.model!r}; known are {', '.join(MODELS)}")
        if len(self.coefficients) not in MODELS[self.model].counts:
            wanted = " or ".join(str(count) for count in MODELS[self.model].counts)
            raise ValueError(f"lens model {self.model}: expected {wanted} coefficients, found {len(self.coefficients)}")
        numbers = (self.fx, self.fy, self.cx, self.cy, self.skew, *self.coefficients)
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"expected finite numbers of the lens, found {numbers}")
        if min(self.fx, self.fy) <= 0:
            raise ValueError(f"expected focal lengths above 0, found {self.fx:g} and {self.fy:g}")

    @classmethod
    def from_opencv(cls, matrix: np.ndarray, coefficients: Sequence[float] = (), *, fisheye: bool = False) -> Lens:
        """Lens of a camera matrix [3, 3] and distortion coefficients in OpenCV's order and pixel count.

        Fewer than four coefficients are completed by zeros, also for fisheye lenses, of which only the first four are
        used.
        """
        (fx, skew, cx), (_, fy, cy) = np.asarray(matrix, np.float64)[:2].tolist()
        values = tuple(float(value) for value in coefficients)
        values = (*values, *[0.0] * (4 - len(values)))
        model = "fisheye" if fisheye else "brown" if any(values) else "pinhole"
        values = values[:4] if fisheye else values if any(values) else ()
        return cls(model, fx, fy, cx + 0.5, cy + 0.5, values, skew)

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrix without distortion, pixels. [3, 3]"""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_pinhole(self) -> bool:
        """True if images need no undistortion."""
        return self.model in ("pinhole", "brown") and not any(self.coefficients) and not self.skew

    def scaled(self, x: float, y: float) -> Lens:
        """Lens of the same image at another resolution; factors of width and height."""
        return dataclasses.replace(
            self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, skew=self.skew * x
        )

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points in camera axes.

        Args:
            points: Points. [N, 3]

        Returns:
            Pixels; NaN for points that the lens does not see: behind it, or beyond the radius at which the model folds
            the image over. [N, 2]
        """
        model = MODELS[self.model]
        plane = distortion.to_plane(model.plane, np.asarray(points, np.float64))
        limit = _profile(self.model, self.coefficients)[0][-1] if self.coefficients else math.inf
        plane = np.where((plane * plane).sum(1, keepdims=True) <= limit * limit, plane, np.nan)
        with np.errstate(invalid="ignore"):
            distorted = model.distort(plane, self.coefficients)
        u = self.fx * distorted[:, 0] + self.skew * distorted[:, 1] + self.cx
        return np.stack([u, self.fy * distorted[:, 1] + self.cy], 1)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Return the directions that pixels see.

        Args:
            pixels: Pixels. [N, 2]

        Returns:
            Unit directions in camera axes; NaN for pixels that no direction reaches. [N, 3]
        """
        pixels = np.asarray(pixels, np.float64)
        b = (pixels[:, 1] - self.cy) / self.fy
        wanted = np.stack([(pixels[:, 0] - self.cx - self.skew * b) / self.fx, b], 1)
        model = MODELS[self.model]
        plane = _undistorted(self.model, self.coefficients, wanted) if self.coefficients else wanted
        if model.plane == distortion.ANGLES:
            plane = np.where((plane * plane).sum(1, keepdims=True) <= math.pi**2, plane, np.nan)
        return distortion.from_plane(model.plane, plane)


@functools.lru_cache(maxsize=64)
def _profile(model: str, coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Radii of a model's plane up to the first at which the image folds over, and their mean distorted radii."""
    widest = _WIDEST[MODELS[model].plane]
    if MODELS[model].plane == distortion.TANGENT:
        radii = np.tan(np.linspace(0.0, math.atan(widest), _RADII + 1)[1:])
    else:
        radii = np.linspace(0.0, widest, _RADII + 1)[1:]
    turn = np.linspace(0.0, 2 * math.pi, _RAYS, endpoint=False)
    points = (radii[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], 1)).reshape(-1, 2)
    with np.errstate(all="ignore"):
        moved, jacobian = _linearised(model, coefficients, points)
        determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
        good = (determinant.reshape(_RADII, _RAYS) > 0).all(1)
        distorted = np.linalg.norm(moved, axis=1).reshape(_RADII, _RAYS).mean(1)
    # The mean radius must grow too, or a pole between two samples would go unnoticed.
    good &= np.diff(distorted, prepend=0.0) > 0
    count = _RADII if good.all() else int(np.argmin(good))
    return np.concatenate([[0.0], radii[:count]]), np.concatenate([[0.0], distorted[:count]])


def _linearised(model: str, coefficients: tuple[float, ...], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distorted points [N, 2] and the Jacobian there, by central differences [N, 2, 2]."""
    distort = MODELS[model].distort
    columns = []
    for axis in range(2):
        step = np.zeros((len(points), 2))
        step[:, axis] = 1e-6 * np.maximum(1.0, np.abs(points[:, axis]))
        columns.append(
            (distort(points + step, coefficients) - distort(points - step, coefficients)) / (2 * step[:, [axis]])
        )
    return distort(points, coefficients), np.stack(columns, 2)


def _undistorted(model: str, coefficients: tuple[float, ...], wanted: np.ndarray) -> np.ndarray:
    """Invert a model by Newton's method from the inverse of its mean radius. [N, 2] -> [N, 2]"""
    radii, distorted = _profile(model, coefficients)
    r = np.linalg.norm(wanted, axis=1)
    start = np.interp(r, distorted, radii)
    scale = np.where(r > 1e-12, start / np.maximum(r, 1e-12), 1.0)
    points = wanted * scale[:, None]
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            moved, jacobian = _linearised(model, coefficients, points)
            determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
            miss = moved - wanted
            points = points - np.stack(
                [
                    (jacobian[:, 1, 1] * miss[:, 0] - jacobian[:, 0, 1] * miss[:, 1]) / determinant,
                    (jacobian[:, 0, 0] * miss[:, 1] - jacobian[:, 1, 0] * miss[:, 0]) / determinant,
                ],
                1,
            )
        miss = np.abs(MODELS[model].distort(points, coefficients) - wanted).max(1)
        solved = (miss < _SOLVED * np.maximum(1.0, r)) & (np.linalg.norm(points, axis=1) <= radii[-1])
    return np.where(solved[:, None], points, np.nan)

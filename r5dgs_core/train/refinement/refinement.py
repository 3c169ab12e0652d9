"""Corrections of the cameras, trained together with the Gaussians.

The picture of a step is drawn by the corrected camera. A small motion of the camera is the opposite motion of all
Gaussians, so the gradients of pose and focal length follow from those of the Gaussians' means, rotations and sizes. The
gradient of time follows from two more sets of posed Gaussians, slightly earlier and later. Each pose and each lens has
its own moments of Adam, because most steps do not show it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import overload

import numpy as np
import torch
from torch import Tensor

from ...scene.camera_correction import POSE, Correction
from ..initialization.color_balance import ColorBalance
from ..representations.fused_posing import PosedSplats
from ..train_views import TrainView
from . import gauge, gradients
from .rig import Rig

POSES, CLOCKS = "camera_poses", "time_offsets"
PARTS = (POSES, "focal_lengths", CLOCKS, "camera_colours")  # rows of the needs table
BETAS, EPS = (0.9, 0.99), 1e-12
REACH = 8.0  # maximum total change of a parameter over the run, in its units
LOWEST, HIGHEST = 0.02, 0.15  # limits of a parameter's first step, units
LAST = 0.05  # last step relative to the first
SMOOTH = 0.02  # share by which a moving camera's correction approaches the mean of its neighbours, per step
TIME_UNIT = 0.02  # unit of time offsets, spacings of the observed times
TIME_STEP = 0.1  # half distance of the differences by time, spacings of the observed times
COLOR_UNIT = 0.02  # unit of gains and offsets
PREFIX = "refine."


@dataclasses.dataclass
class _Rows:
    """Rows of one kind of parameter, with their moments of Adam.

    Attributes:
        values: Corrections in their own units. [R, ...]
        first, second: Moments. [R, ...]
        counts: Steps taken by each row. [R]
    """

    values: np.ndarray
    first: np.ndarray
    second: np.ndarray
    counts: np.ndarray

    @classmethod
    def zeros(cls, *shape: int) -> _Rows:
        """Return rows without correction."""
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape[0]))

    def change(self, row: int, gradient: np.ndarray, rate: float) -> np.ndarray:
        """Update the moments of a row with a gradient; return the step."""
        self.counts[row] += 1
        for moment, beta, value in ((self.first, BETAS[0], gradient), (self.second, BETAS[1], gradient**2)):
            moment[row] = beta * moment[row] + (1 - beta) * value
        mean, square = (
            m[row] / (1 - b ** self.counts[row]) for m, b in zip((self.first, self.second), BETAS, strict=True)
        )
        return -rate * mean / (np.sqrt(square) + EPS)


class Refinement:
    """Corrections of all cameras of a run, in normalised coordinates.

    Args:
        rig: Poses and lenses of the views.
        spacing: Typical spacing of the observed times.
        steps: Steps of the whole run.

    Attributes:
        parts: Parts that are trained, from `PARTS`; empty before the decision or if no camera needs a correction.
        gains: Largest gain of each part on pixels to which it was not fitted, dB, in the order of `PARTS`; nan if it
            was not examined; None before the decision. [4]
        sizes: Largest size of each part on which the pictures agree (`agreement.Evidence`), likewise. [4]
        settled: Parts that were adjusted to patches of the images (`patch_trial`), which training does not change.
    """

    def __init__(self, rig: Rig, spacing: float, steps: int):
        self.rig = rig
        self.parts: frozenset[str] = frozenset()
        self.settled: frozenset[str] = frozenset()
        self.gains: np.ndarray | None = None
        self.sizes = np.full(len(PARTS), math.nan)
        self._spacing, self._steps, self._begin = spacing, steps, 0
        self._poses = _Rows.zeros(rig.poses, 6)
        self._focal = _Rows.zeros(rig.lenses, 1)
        self._time = _Rows.zeros(rig.lenses, 1)
        self._color = _Rows.zeros(rig.lenses, 3, 2)  # gain - 1 and offset of each channel
        self._units = np.zeros((rig.poses, 6, 6))
        self._gauge: gauge.Gauge | None = None
        self._color_leaf: Tensor | None = None
        self._neighbours = {
            int(r): (int(a), int(b)) for path in rig.paths for a, r, b in zip(path, path[1:], path[2:], strict=False)
        }

    @property
    def active(self) -> bool:
        """True if any part is trained."""
        return bool(self.parts)

    def learn(self, evidence: Mapping[str, tuple[float, float]]) -> None:
        """Keep size and gain of the parts that were examined."""
        found = np.array([evidence.get(part, (math.nan, math.nan)) for part in PARTS])
        self.sizes = np.fmax(self.sizes, found[:, 0])
        self.gains = found[:, 1] if self.gains is None else np.fmax(self.gains, found[:, 1])

    def change(self, changes: Mapping[str, np.ndarray], *, final: bool) -> None:
        """Change the poses or clocks of all cameras, each with one lens.

        Args:
            changes: Change of the poses [R, 6] or the clocks [R] by part.
            final: True to keep them from training.
        """
        self._poses.values += changes.get(POSES, 0.0)
        self._time.values[self.rig.lens_of_pose, 0] += changes.get(CLOCKS, 0.0)
        self.settled |= changes.keys() if final else set()

    def begin(
        self, parts: Sequence[str], points: np.ndarray, iteration: int, changes: Mapping[int, np.ndarray]
    ) -> None:
        """Begin to train some parts, or continue with further ones.

        Args:
            parts: From `PARTS`.
            points: Points of the scene, for the units of the poses. [N, 3]
            iteration: The step.
            changes: Change of the correction of some poses, as for `Correction.plus`; each [COUNT].
        """
        if self._gauge is None:
            self._begin = iteration
            chosen = points[:: max(1, len(points) // gauge.POINTS)]
            self._units = np.stack([gauge.pixel_units(camera, chosen) for camera in self.rig.cameras])
            self._gauge = gauge.Gauge(self.rig.cameras, self._units)
        self.parts = frozenset(parts)
        shared = np.bincount(self.rig.lens_of_pose[list(changes)], minlength=self.rig.lenses)
        for row, change in changes.items():
            lens = self.rig.lens_of_pose[row]
            new = Correction().plus(change)
            self._poses.values[row] += change[POSE]
            self._focal.values[lens] += new.log_focal / shared[lens]
            self._time.values[lens] += new.time / shared[lens]
            color = np.stack([np.diag(new.gain) - 1, new.offset], axis=1)
            self._color.values[lens] += color / shared[lens]
        self._fix()

    def begin_colors(self, balance: ColorBalance) -> None:
        """Begin to train the colours of all lenses, from those of the background images."""
        rows = [balance.names.index(name) for name in self.rig.lens_names]
        self.parts |= {"camera_colours"}
        change = 0.5 * (balance.gains - 1) + balance.offsets  # of middle grey
        self.learn({"camera_colours": (float(np.sqrt(np.mean(change**2))), balance.gain_db)})
        self._color.values[:] = np.stack([balance.gains[rows] - 1, balance.offsets[rows]], axis=-1)
        self._fix()

    def correction(self, row: int) -> Correction:
        """Return the correction of a pose, normalised coordinates."""
        lens = int(self.rig.lens_of_pose[row])
        pose, color = self._poses.values[row], self._color.values[lens]
        return Correction(
            pose[:3].copy(),
            pose[3:].copy(),
            float(self._focal.values[lens, 0]),
            float(self._time.values[lens, 0]),
            np.diag(1 + color[:, 0]),
            color[:, 1].copy(),
        )

    def view(self, index: int, given: TrainView) -> TrainView:
        """Return a training view with its corrected camera and time."""
        if not self.active:
            return given
        correction = self.correction(int(self.rig.pose_of[index]))
        return dataclasses.replace(given, camera=correction.camera(given.camera), t=given.t + correction.time)

    def shade(self, image: Tensor, target: Tensor, index: int) -> Tensor:
        """Return the picture in the colours of a view's camera; differentiable in both.

        Colours that are saturated in the image may be brighter in the picture.

        Args:
            image: The picture. [H, W, 3]
            target: The image. [H, W, 3]
            index: The view.
        """
        if "camera_colours" not in self.parts:
            return image
        leaf = torch.from_numpy(self._color.values[self.rig.lens_of[index]]).to(image)
        self._color_leaf = leaf.requires_grad_(torch.is_grad_enabled())
        shaded = image + image * leaf[:, 0] + leaf[:, 1]
        return torch.where((target >= 1) & (shaded > 1), target, shaded)

    def watch(self, splats: PosedSplats) -> None:
        """Keep the gradients of the splats of a step."""
        if self.active:
            for tensor in (splats.means, splats.quats, splats.scales):
                if tensor.requires_grad:
                    tensor.retain_grad()

    @torch.no_grad()
    def measure(
        self, index: int, view: TrainView, splats: PosedSplats, pose: Callable[[float], PosedSplats]
    ) -> np.ndarray | None:
        """Return the gradients by the correction of a view's camera after the backward pass of a step.

        Args:
            index: The view.
            view: The view as it was drawn.
            splats: Its splats, with gradients.
            pose: Returns the splats at another time.

        Returns:
            Gradients by pose (6), focal length, time, and gains and offsets of the colours (6), which are nan without
            such gradients. None if no part is trained. [14]
        """
        leaf, self._color_leaf = self._color_leaf, None
        if not self.active or splats.means.grad is None:
            return None
        shift = self._poses.values[int(self.rig.pose_of[index]), 3:]
        by_pose, by_focal = gradients.camera_gradient(view, splats, shift)
        by_time, h = 0.0, TIME_STEP * self._spacing
        if CLOCKS in self.parts - self.settled:
            by_time = gradients.time_gradient(splats, pose(view.t - h), pose(view.t + h)) / (2 * h)
        by_color = np.full((3, 2), math.nan)
        if leaf is not None and leaf.grad is not None:
            by_color = leaf.grad.cpu().numpy().astype(np.float64)
        return np.concatenate([by_pose, [by_focal, by_time], by_color.ravel()])

    def apply(self, index: int, width: int, measured: np.ndarray | None, iteration: int) -> None:
        """Update the corrections of a view's camera.

        Args:
            index: The view.
            width: Width of its image, px.
            measured: Result of `measure`.
            iteration: The step.
        """
        if measured is None:
            return
        row, lens = int(self.rig.pose_of[index]), int(self.rig.lens_of[index])
        by_pose, by_focal, by_time, by_color = measured[:6], measured[6], measured[7], measured[8:].reshape(3, 2)
        trained = self.parts - self.settled
        if POSES in trained:
            step = self._poses.change(row, self._units[row].T @ by_pose, self._rate(self._poses, iteration))
            self._poses.values[row] += self._units[row] @ step
            self._smooth(row)
        if "focal_lengths" in trained:
            unit = 2 / width
            step = self._focal.change(lens, np.array([by_focal * unit]), self._rate(self._focal, iteration))
            self._focal.values[lens] += unit * step
        if CLOCKS in trained:
            unit = TIME_UNIT * self._spacing
            step = self._time.change(lens, np.array([by_time * unit]), self._rate(self._time, iteration))
            self._time.values[lens] += unit * step
        if np.isfinite(by_color).all():
            step = self._color.change(lens, by_color, self._rate(self._color, iteration))
            self._color.values[lens] += COLOR_UNIT * step
        self._fix()

    def _rate(self, rows: _Rows, iteration: int) -> float:
        """Return the step of Adam in units of a parameter; it decays until the end of the run."""
        left = max(1, self._steps - self._begin)
        first = min(max(REACH * len(rows.values) / left, LOWEST), HIGHEST)
        return first * LAST ** min(1.0, max(0.0, (iteration - self._begin) / left))

    def _smooth(self, row: int) -> None:
        if row in self._neighbours:
            before, after = self._neighbours[row]
            values = self._poses.values
            values[row] += SMOOTH * (0.5 * (values[before] + values[after]) - values[row])

    def _fix(self) -> None:
        """Remove changes that no image determines: a similarity of the world, and the means of the other parts."""
        if self._gauge is not None and POSES in self.parts:
            self._poses.values = self._gauge.fix(self._poses.values)
        for rows in (self._focal, self._time, self._color):
            rows.values -= rows.values.mean(0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by ``refine.NAME``; empty before the decision."""
        if self.gains is None:
            return {}
        named = {
            "gains": self.gains,
            "sizes": self.sizes,
            "on": np.array([part in self.parts for part in PARTS]),
            "settled": np.array([part in self.settled for part in PARTS]),
            "begin": np.array(self._begin),
        }
        if self.active:
            if self._gauge is not None:
                named["units"] = self._units
            for name, rows in self._kinds().items():
                named |= {f"{name}.{field}": value for field, value in vars(rows).items()}
        return {PREFIX + name: torch.from_numpy(np.array(value)) for name, value in named.items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        named = {n.removeprefix(PREFIX): t.numpy().copy() for n, t in tensors.items() if n.startswith(PREFIX)}
        self.parts, self.gains, self._gauge = frozenset(), named.get("gains"), None
        self.sizes = named.get("sizes", np.full(len(PARTS), math.nan))
        self.settled = frozenset(part for part, on in zip(PARTS, named.get("settled", ()), strict=False) if on)
        if self.gains is not None:
            self._begin = int(named["begin"])
            self.parts = frozenset(part for part, on in zip(PARTS, named["on"], strict=True) if on)
        for name, rows in self._kinds().items():
            for field, values in vars(rows).items():
                values[...] = named[f"{name}.{field}"] if self.active else 0.0
        if "units" in named:
            self._units = named["units"]
            self._gauge = gauge.Gauge(self.rig.cameras, self._units)

    def _kinds(self) -> dict[str, _Rows]:
        return {"poses": self._poses, "focal": self._focal, "time": self._time, "color": self._color}


class RefinedViews(Sequence[TrainView]):
    """Training views with the present corrections of their cameras.

    Args:
        given: Views as in the data set.
        refinement: The corrections.
    """

    def __init__(self, given: Sequence[TrainView], refinement: Refinement):
        self.given = given
        self._refinement = refinement

    def __len__(self) -> int:
        return len(self.given)

    @overload
    def __getitem__(self, index: int) -> TrainView: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[TrainView]: ...

    def __getitem__(self, index: int | slice) -> TrainView | Sequence[TrainView]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self._refinement.view(range(len(self))[index], self.given[index])

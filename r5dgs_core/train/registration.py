"""Registration of one body at one knot: the pose at which the canonical Gaussians reproduce the body's pixels.

Only the pose changes; the Gaussians stay fixed. Images are cropped to the body's masks, only Gaussians that reach the
crop are drawn, and harmonics of higher degree are left out. Notation: a change of a pose is a rotation vector about the
body's centre in world axes, and a displacement in radii of the body; P values of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from ..model.group_poses import GroupPoses
from ..motion import rotations
from ..motion.se3 import Pose
from ..raster import rasterize_splats
from ..raster.arrays import to_host
from ..scene import cameras, sampling, spherical_harmonics
from ..scene.cameras import Camera
from . import train_views
from .representations import fused_posing
from .representations.fused_posing import PosedSplats
from .representations.tracks import TracksRepresentation
from .trainer import Trainer

MARGIN = 2  # dilation of masks, px
MIN_PIXELS = 8  # minimum number of pixels of a mask
BLUR = 0.05  # standard deviation that blurs pictures for a start from afar, relative to the root of the body's pixels
STEP = 0.02  # change of the pose for finite differences, rad or radii
_LARGEST = 0.35  # step of the refinement, rad or radii
_ENOUGH = 1e-2  # relative gain of a step below which the refinement ends
_FIELDS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class _Look:
    """A view of the body: the crop of its picture, the sky in it, and the posed Gaussians of other groups there."""

    camera: Camera
    truth: np.ndarray
    region: np.ndarray
    others: PosedSplats
    behind: torch.Tensor


class BodyRegistration:
    """Pictures of a body at a knot.

    Args:
        trainer: A run.
        motion: Its tracks.
        body: Row of the body.
        knot: The knot.
        most: Largest number of views, spread evenly over those that show the body.

    Attributes:
        radius: Radius of the body, normalised units.
    """

    def __init__(self, trainer: Trainer, motion: TracksRepresentation, body: int, knot: int, most: int):
        self._trainer, self._motion, self._body, self._knot = trainer, motion, body, knot
        owner = int(motion.tracks.owners[body])
        self.radius = float(trainer.places.radii[owner - 1])
        object_id, params = int(trainer.object_ids[owner]), trainer.gaussians.params
        rows = torch.nonzero(trainer.gaussians.motion_ids == body)[:, 0]
        names = ("means", "quats", "log_scales", "opacity_logits", "shading")
        self._shape = {name: params[name].detach()[rows] for name in names}
        self._shape["colors"] = spherical_harmonics.dc_to_rgb(params["sh"].detach()[rows, 0])
        shown = sampling.spread([v for v in views_at(trainer, knot) if (v.mask == object_id).sum() >= MIN_PIXELS], most)
        self._looks = [self._look(view, view.mask == object_id) for view in shown]
        self._free = np.eye(3)  # directions in which the views determine the position
        if len(self._looks) == 1:
            away = self.pose[1] + to_host(motion.tracks.centers[body]) - self._looks[0].camera.center
            self._free -= np.outer(away, away) / (away @ away)

    def __len__(self) -> int:
        """Number of views."""
        return len(self._looks)

    def _entries(self) -> list[torch.Tensor]:
        """Parts of the tracks that hold the pose: base rotation [4], rotation vector [3] and displacement [3]."""
        tracks = self._motion.tracks
        every = (tracks.base_quats, tracks.params["rotvecs"].detach(), tracks.params["translations"].detach())
        return [x[self._body, self._knot] for x in every]

    @property
    def pose(self) -> Pose:
        """The body's pose in the tracks: unit wxyz [4] and displacement [3], float64."""
        base, rotvec, shift = (to_host(x).astype(np.float64) for x in self._entries())
        return rotations.normalize(rotations.multiply(rotations.rotvecs_to_quats(rotvec), base)), shift

    def write_pose(self, pose: Pose) -> None:
        """Write a pose into the tracks."""
        quat, shift = (self._tensor(x) for x in pose)
        for entry, value in zip(self._entries(), (quat, torch.zeros_like(shift), shift), strict=True):
            entry.copy_(value)

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).float().to(self._motion.light.device)

    def error(self, pose: Pose) -> float:
        """Mean squared error of the body's pixels."""
        return float((self._residuals(pose) ** 2).mean())

    def refined_from_afar(self, pose: Pose, steps: int) -> tuple[Pose, float]:
        """Return `refined` after a refinement of blurred pictures, which have wider minima."""
        return self.refined(self.refined(pose, steps, BLUR)[0], steps)

    def refined(self, pose: Pose, steps: int, blur: float = 0.0) -> tuple[Pose, float]:
        """Return the pose of least picture error near a pose, and this error, by damped Gauss-Newton steps.

        Args:
            pose: The start.
            steps: Largest number of steps.
            blur: Standard deviation by which the pictures are blurred, relative to the size of the body in them.
        """
        residuals, damping = self._residuals(pose, blur), 1e-2
        error = float((residuals**2).mean())
        for _ in range(steps):
            moved = [self._residuals(self._moved(pose, change), blur) for change in STEP * np.eye(6)]
            slopes = (np.stack(moved, -1) - residuals[:, None]) / STEP  # [P, 6]
            normal = slopes.T @ slopes
            diagonal = np.diag(np.diag(normal) + 1e-6 * max(float(np.trace(normal)), 1e-12))
            for _ in range(3):
                change = -np.linalg.solve(normal + damping * diagonal, slopes.T @ residuals)
                change *= min(1.0, _LARGEST / max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:]), 1e-9))
                there = self._moved(pose, change)
                new = self._residuals(there, blur)
                gain = 1 - float((new**2).mean()) / error
                if gain > 0:
                    break
                damping *= 10
            else:
                break
            pose, residuals, error, damping = there, new, (1 - gain) * error, 0.3 * damping
            if gain < _ENOUGH:
                break
        return pose, error

    def _moved(self, pose: Pose, change: np.ndarray) -> Pose:
        turned = rotations.multiply(rotations.rotvecs_to_quats(change[:3]), pose[0])
        return rotations.normalize(turned), pose[1] + self.radius * self._free @ change[3:]

    @torch.no_grad()
    def _residuals(self, pose: Pose, blur: float = 0.0) -> np.ndarray:
        """Picture minus truth in the region of the body. [P] float64"""
        quat, shift = (self._tensor(x)[None] for x in pose)
        placed = GroupPoses(quat, rotations.quats_to_rotmats(quat), shift)
        group = torch.zeros_like(self._shape["opacity_logits"], dtype=torch.int64)
        center, light = self._motion.tracks.centers[self._body][None], self._motion.light.detach()
        mine = fused_posing.pose(**self._shape, light=light, motion_ids=group, group_poses=placed, centers=center)
        found = []
        for look in self._looks:
            means, quats, scales, opacities, colors = (
                torch.cat([getattr(part, name) for part in (mine, look.others)]) for name in _FIELDS
            )
            drawn = rasterize_splats(means, quats, scales, opacities, colors, look.camera, look.behind).image
            image = to_host(drawn)
            if blur > 0:
                image = lit_alike(image, look.truth, look.region)
            found.append(blurred(image - look.truth, look.region, blur)[look.region].ravel())
        return np.concatenate(found).astype(np.float64)

    @torch.no_grad()
    def _look(self, view: train_views.TrainView, mine: np.ndarray) -> _Look:
        region = grown(mine)
        rows, columns = ndimage.find_objects(region.astype(np.int8))[0]
        size = columns.stop - columns.start, rows.stop - rows.start
        camera = cameras.crop(view.camera, columns.start, rows.start, *size)
        splats = self._trainer.splats(camera, view.t)
        near = self._others_near(camera, splats)
        others = PosedSplats(**{name: getattr(splats, name)[near] for name in _FIELDS})
        truth, behind = view.image[rows, columns].astype(np.float32) / 255, self._trainer.background.image(camera)
        return _Look(camera, truth, region[rows, columns], others, behind)

    def _others_near(self, camera: Camera, splats: PosedSplats) -> torch.Tensor:
        """Rows of the Gaussians of other groups that reach a camera's picture."""
        centers, scales = to_host(splats.means).astype(np.float64), to_host(splats.scales.amax(1))
        other = to_host(self._trainer.gaussians.motion_ids) != self._body
        rows = np.flatnonzero(other & cameras.reached_by(camera, centers, scales))
        return torch.from_numpy(rows).to(splats.means.device)


def views_at(trainer: Trainer, knot: int) -> list[train_views.TrainView]:
    """Return the views with masks at a knot."""
    return [v for v in trainer.views if v.has_mask and train_views.nearest_knot(trainer.times, v.t) == knot]


def lit_alike(image: np.ndarray, truth: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return an image with the gain and offset of each channel that bring it nearest to another one in a region.

    Light changes as a body moves, and it would shift the minima of blurred pictures.

    Args:
        image: The image. [H, W, D]
        truth: The other one. [H, W, D]
        region: The region. [H, W] bool
    """
    a, b = image[region].astype(np.float64), truth[region].astype(np.float64)
    spread = np.maximum(a.var(0), 1e-6)
    gain = np.maximum(((a - a.mean(0)) * (b - b.mean(0))).mean(0) / spread, 0.0)
    return gain * (image - a.mean(0)) + b.mean(0)


def blurred(image: np.ndarray, region: np.ndarray, blur: float) -> np.ndarray:
    """Return an image, 0 outside a region, blurred by a Gaussian.

    Args:
        image: The image. [H, W, D]
        region: The region. [H, W] bool
        blur: Standard deviation relative to the root of the pixels of the region; 0 returns the image itself.
    """
    if blur <= 0:
        return image
    sigma = blur * float(np.sqrt(region.sum()))
    return ndimage.gaussian_filter(np.where(region[..., None], image, 0), (sigma, sigma, 0))


def grown(mask: np.ndarray) -> np.ndarray:
    """Return the region in which a body is compared: its mask with a margin. [H, W] bool"""
    return np.asarray(ndimage.binary_dilation(mask, iterations=MARGIN), bool)


@torch.no_grad()
def errors(trainer: Trainer, knot: int, most: int) -> np.ndarray:
    """Return the mean squared error of each body's pixels at a knot in the tracks; nan if no mask shows it. [B - 1]"""
    ids = [int(i) for i in trainer.object_ids[1:]]
    sums, pixels = np.zeros(len(ids)), np.zeros(len(ids))
    for view in sampling.spread(views_at(trainer, knot), most):
        squares, mask = (to_host(trainer.render(view.camera, view.t)) - view.image / 255.0) ** 2, view.mask
        for row, object_id in enumerate(ids):
            mine = mask == object_id
            if mine.sum() >= MIN_PIXELS:
                sums[row] += squares[grown(mine)].sum()
                pixels[row] += 3 * grown(mine).sum()
    return np.where(pixels > 0, sums / np.maximum(pixels, 1), np.nan)

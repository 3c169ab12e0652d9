"""Space in which no background can be: the masks show objects there, and nothing hides these.

Each camera has a map of depths: at a pixel, the largest depth of the near side of an object that a mask shows there.
Objects move, so a map covers more than one mask. Background at a smaller depth is wrong, as it would hide an object
that the camera sees. This happens if few cameras share a background, because its depth is then ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage

from ...model.gaussians import Gaussians
from ...raster.arrays import to_host
from ...scene import cameras
from ...scene.cameras import Camera
from ...scene.sampling import spread
from ..train_views import MASK, TrainView, by_camera, in_turn, nearest_knot
from .triangulation import ObjectPositions

MAX_CAMERAS = 64
MAX_FRAMES = 64  # frames of a camera
LINES = 180  # maximum height of a map
BORDER = 2  # erosion of masks, pixels of the map
AMBIGUOUS = 0.01  # share of the initial background in the free space above which it is cleared
INVISIBLE = -8.0  # logit of an opacity that is not drawn
CLEAR_EVERY = 100  # steps


class FreeSpace:
    """Depths up to which cameras see no background.

    Args:
        views: Training views; those without masks are ignored.
        times: Knots. [S]
        places: Positions of the objects.
    """

    def __init__(self, views: Sequence[TrainView], times: np.ndarray, places: ObjectPositions):
        masked = [view for view in views if view.has_mask]
        groups = by_camera(masked, MAX_CAMERAS) if len(places.object_ids) else []
        maps = [(group[0].camera, _depths(spread(group, MAX_FRAMES), times, places)) for group in groups]
        self._maps: list[tuple[Camera, np.ndarray]] = [(camera, depths) for camera, depths in maps if depths.any()]

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Mask of the points that lie in the free space. [P, 3] -> [P] bool"""
        inside = np.zeros(len(points), bool)
        for camera, depths in self._maps:
            pixels, z = cameras.project(camera, points)
            size = np.array(depths.shape[::-1])
            at = pixels * (size / [camera.width, camera.height])
            rows = np.flatnonzero((z > 0) & (at >= 0).all(1) & (at < size).all(1))
            column, row = at[rows].astype(int).T
            inside[rows] |= z[rows] < depths[row, column]
        return inside


def find(
    views: Sequence[TrainView], times: np.ndarray, places: ObjectPositions, background: np.ndarray
) -> FreeSpace | None:
    """Return the free space if the depth of the background is ambiguous: more than a few of its points lie in it.

    Args:
        views: Training views.
        times: Knots. [S]
        places: Positions of the objects.
        background: Initial points. [P, 3]
    """
    space = FreeSpace(views, times, places)
    return space if space.contains(background).sum() > AMBIGUOUS * len(background) else None


@torch.no_grad()
def clear(space: FreeSpace, gaussians: Gaussians) -> None:
    """Make the background Gaussians in the free space invisible; densification then removes them."""
    background = torch.nonzero(gaussians.motion_ids == 0)[:, 0]
    inside = space.contains(to_host(gaussians.params["means"][background]).astype(np.float64))
    rows = background[torch.from_numpy(np.flatnonzero(inside)).to(background.device)]
    gaussians.params["opacity_logits"][rows] = INVISIBLE


def _depths(views: Sequence[TrainView], times: np.ndarray, places: ObjectPositions) -> np.ndarray:
    """Return the depths up to which a camera sees no background, 0 if no mask shows an object. [h, w] float32"""
    camera = views[0].camera
    stride = -(-camera.height // LINES)
    rows, columns = (np.arange(stride // 2, size, stride) for size in (camera.height, camera.width))
    depths = np.zeros((len(rows), len(columns)), np.float32)
    for view in in_turn(views, MASK):
        knot, mask = nearest_knot(times, view.t), view.mask
        assert mask is not None
        sampled = mask[np.ix_(rows, columns)]
        depth = cameras.project(camera, places.centers[:, knot])[1] - places.radii  # of the near sides
        for body in np.flatnonzero(places.measured[:, knot] & (depth > 0)):
            shown = np.asarray(ndimage.binary_erosion(sampled == places.object_ids[body], iterations=BORDER), bool)
            depths = np.where(shown, np.maximum(depths, np.float32(depth[body])), depths)
    return depths

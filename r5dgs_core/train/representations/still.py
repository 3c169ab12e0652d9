"""Representation `still`: nothing moves, and only the Gaussians are trained.

It is chosen if ``needs.tracks`` is "off", if all images show one time, or if no camera's image changes over time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ...config.config import Config
from ...model.gaussians import Gaussians
from ...motion import robust_weights, rotations
from ...raster import shade
from ...scene import spherical_harmonics
from ...scene.cameras import Camera
from ..initialization import initialize
from ..observed_motion import GroupTrack, ObservedMotion
from ..train_views import IMAGE, TrainView, by_camera, in_turn
from . import fused_posing
from .representation import STILL, Representation

BLOCK = 4  # side of the averaged blocks, px
CHANGE = 3.0  # minimum significant change of a block, levels of 255
NOISE = 8.0  # the same in standard deviations of the change over all blocks
NOTHING = 0.3  # lower limit of the noise of 8-bit images, levels of 255


class StillRepresentation(Representation):
    """Gaussians that never move.

    Args:
        start: Initial state of training.
    """

    name, moves = STILL, False

    def __init__(self, start: initialize.InitialState):
        self.centers = torch.from_numpy(start.tracks.centers.astype(np.float32))
        self.time = float(start.tracks.times[-1])

    def to(self, device: torch.device) -> StillRepresentation:
        """See `Representation.to`."""
        self.centers = self.centers.to(device)
        return self

    def splats(self, gaussians: Gaussians, camera: Camera, t: float) -> fused_posing.PosedSplats:
        """See `Representation.splats`; the result is the same at all times."""
        params = gaussians.params
        if params["sh_rest"].shape[1] == 0:
            colors = spherical_harmonics.dc_to_rgb(params["sh"][:, 0])
        else:
            eye, means = np.asarray(camera.center)[None], params["means"].detach()
            colors = shade.seen_colors(means, params["sh"], eye, rest=params["sh_rest"])
        return fused_posing.activate(
            params["means"], params["quats"], params["log_scales"], params["opacity_logits"], colors
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return the centres of the objects and the last observed time."""
        return {"still.centers": self.centers, "still.time": torch.tensor(self.time, dtype=torch.float64)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state from `tensors`."""
        self.centers, self.time = tensors["still.centers"], float(tensors["still.time"])

    @staticmethod
    def group_classes(tensors: dict[str, Tensor]) -> np.ndarray:
        """See `Representation.group_classes`."""
        return np.arange(len(tensors["still.centers"]))

    @staticmethod
    def observed_motion(
        tensors: dict[str, Tensor], object_ids: np.ndarray, observed: np.ndarray, labels: np.ndarray, config: Config
    ) -> ObservedMotion:
        """See `Representation.observed_motion`: one knot, at which every group is at rest."""
        centers = tensors["still.centers"].numpy().astype(np.float64)
        rest, nowhere = rotations.identity(1), np.zeros((1, 3))
        groups = [GroupTrack(0, "pinned", centers[0], rest, nowhere, np.ones(1, bool))]
        for body in range(1, len(centers)):
            seen = observed[body - 1].any(keepdims=True)
            groups.append(GroupTrack(int(object_ids[body]), "body", centers[body], rest, nowhere, seen))
        return ObservedMotion(np.array([float(tensors["still.time"])]), tuple(groups), np.zeros(3), smooth=True)


def applies(views: Sequence[TrainView], config: Config) -> bool:
    """True if a run needs no motion: by the user's ``needs.tracks``, or because nothing moves in the training views."""
    return config.needs.tracks == "off" or (config.needs.tracks == "auto" and nothing_moves(views))


def nothing_moves(views: Sequence[TrainView]) -> bool:
    """True if all images show one time, or no camera's image changes over time.

    False if a camera (such as a moving one) shows only one time, as its changes cannot be compared.
    """
    if len({view.t for view in views}) <= 1:
        return True
    cameras = by_camera(views)
    if any(len({view.t for view in group}) < 2 for group in cameras):
        return False
    for first, *others in cameras:
        blocks = _blocks(first.image)
        if any(_changes(blocks, _blocks(view.image)) for view in in_turn(others, IMAGE)):
            return False
    return True


def _changes(first: np.ndarray, second: np.ndarray) -> bool:
    """True if two images of one camera, as blocks, differ by more than noise in at least one block."""
    difference = np.abs(first - second)
    noise = max(robust_weights.MEDIAN_TO_SIGMA * float(np.median(difference)), NOTHING)
    return bool((difference > max(CHANGE, NOISE * noise)).any())


def _blocks(image: np.ndarray) -> np.ndarray:
    """Means of blocks; incomplete blocks at the right and lower border are left out. [H, W, 3]"""
    height, width = (max(1, size // BLOCK) for size in image.shape[:2])
    tall, wide = (min(BLOCK, size) for size in image.shape[:2])
    whole = image[: height * tall, : width * wide].astype(np.float32)
    return whole.reshape(height, tall, width, wide, 3).mean((1, 3))

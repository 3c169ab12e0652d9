"""A scene drawn frame after frame by one camera: what has not moved since the last frame is not drawn again.

Which instances move is learned from the frames themselves. Under a new camera, or after another change of what is
shown or behind it, everything is drawn; from the next frame on, the instances that have kept their place are a
`Backdrop`, and only those that have ever left theirs are drawn into it. The pictures are those of
`scene_render.render_frame`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import numpy as np
import torch

from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import scene_render, splatting
from .scene_render import Instance
from .settings import RasterSettings, RenderOutput

WORTH_A_BACKDROP = 0.7  # largest share of moving Gaussians; with more, keeping the rest costs what it saves


class Stage:
    """Draws one scene again and again, on the CPU in float32.

    Attributes:
        ms_motion: What bringing Gaussians to their places took in the last frame, milliseconds.
    """

    def __init__(self, scene: Scene):
        self.ms_motion = 0.0
        self._lock = threading.Lock()
        self._scene = scene
        self._shown: tuple | None = None  # camera, background and ranges of the last frame
        self._places: list[np.ndarray] = []  # of all instances, where they stood first
        self._moving: set[int] = set()
        self._backdrop = None

    def render(self, instances: Sequence[Instance], camera: Camera, *, sky: bool = True) -> RenderOutput:
        """Render ranges of the scene's Gaussians, each moved by a matrix of its own.

        Args:
            instances: As for `scene_render.pose_instances`; compared with those of the last frame one by one.
            camera: The camera, in the scene's world.
            sky: Whether the scene's sky is behind everything, or black.

        Returns:
            Colour (not clamped at 1), alpha, depth and object ids, tensors without gradient.

        Raises:
            ValueError: As `scene_render.pose_instances`.
        """
        with self._lock:
            try:
                return self._render(instances, camera, sky)
            except ValueError:
                self._shown = None
                scene_render.pose_instances(self._scene, instances)  # numbers the bad instance as the caller does
                raise

    def _render(self, instances: Sequence[Instance], camera: Camera, sky: bool) -> RenderOutput:
        self.ms_motion = 0.0
        view = (camera.width, camera.height, camera.intrinsics.tobytes(), camera.T_cam_world.tobytes())
        shown = (view, sky, tuple((instance.start, instance.count) for instance in instances))
        if shown != self._shown:
            self._shown, self._backdrop, self._moving = shown, None, set()
            self._places = [np.array(instance.matrix, np.float64) for instance in instances]
            return self._render_all(instances, camera, sky)
        left = {i for i, one in enumerate(instances) if not np.array_equal(one.matrix, self._places[i])}
        if not left <= self._moving:
            self._moving |= left
            self._backdrop = None
        moving = [i for i in range(len(instances)) if i in self._moving]
        still = [i for i in range(len(instances)) if i not in self._moving]
        if not self._has_backdrop(instances, still, moving):
            return self._render_all(instances, camera, sky)
        if self._backdrop is None:
            self._backdrop = self._make_backdrop(instances, still, camera, sky)
        means, quats, scales, opacities, colors, labels = self._splats(instances, moving, camera)
        picture = self._backdrop.draw(
            means, quats, scales, opacities, colors, labels=labels, ranks=_ranks(instances, moving)
        )
        return RenderOutput(picture.image, picture.alpha, picture.depth, None, picture.ids)

    def _has_backdrop(self, instances: Sequence[Instance], still: list[int], moving: list[int]) -> bool:
        if not splatting.numba_is_there():
            return False
        moved, kept = (sum(instances[i].count for i in part) for part in (moving, still))
        return kept > 0 and moved <= WORTH_A_BACKDROP * (moved + kept)

    def _make_backdrop(self, instances: Sequence[Instance], still: list[int], camera: Camera, sky: bool):
        from .backdrop import Backdrop

        background = scene_render.tensor(scene_render.behind(self._scene, camera)) if sky else None
        means, quats, scales, opacities, colors, labels = self._splats(instances, still, camera)
        settings = RasterSettings(near_plane=self._scene.near_plane)
        return Backdrop(
            means, quats, scales, opacities, colors, camera, background,
            labels=labels, ranks=_ranks(instances, still), settings=settings,
        )  # fmt: skip

    def _splats(self, instances: Sequence[Instance], part: list[int], camera: Camera) -> tuple[torch.Tensor, ...]:
        """Means, quats, scales, opacities, colours and object ids of some instances."""
        posed = self._pose([instances[i] for i in part])
        gaussians = scene_render.PosedGaussians(posed)
        colors = scene_render.tensor(scene_render.colors(posed, camera))
        return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors, gaussians.object_ids

    def _render_all(self, instances: Sequence[Instance], camera: Camera, sky: bool) -> RenderOutput:
        return scene_render.render_frame(
            self._scene, self._pose(instances), camera, background="scene" if sky else None
        )

    def _pose(self, instances: Sequence[Instance]) -> scene_render.PosedScene:
        start = time.perf_counter()
        posed = scene_render.pose_instances(self._scene, instances)
        self.ms_motion += 1e3 * (time.perf_counter() - start)
        return posed


def _ranks(instances: Sequence[Instance], part: list[int]) -> np.ndarray:
    """Place of each Gaussian of some instances among those of all. [n]"""
    starts = np.cumsum([0, *(instance.count for instance in instances)])
    return np.concatenate([np.arange(starts[i], starts[i + 1]) for i in part] or [np.arange(0)])

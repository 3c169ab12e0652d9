"""A scene drawn frame after frame by one camera: what has not moved since the last frame is not drawn again.

Which instances move is learned from the frames themselves. Under a new camera, or after another change of what is
shown or behind it, everything is drawn; from the next frame on, the instances that have kept their place are a
`Backdrop`, and only those that have ever left theirs are drawn into it. The pictures are those of
`scene_render.render_frame`.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence

import numpy as np
import torch

from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import scene_render
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
        """
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
        moving = [instance for i, instance in enumerate(instances) if i in self._moving]
        still = [instance for i, instance in enumerate(instances) if i not in self._moving]
        if not self._has_backdrop(still, moving):
            return self._render_all(instances, camera, sky)
        if self._backdrop is None:
            self._backdrop = self._make_backdrop(still, camera, sky)
        with torch.no_grad():
            picture = self._backdrop.draw(*self._splats(moving, camera))
        return RenderOutput(picture.image, picture.alpha, picture.depth, None, picture.ids)

    def _has_backdrop(self, still: list[Instance], moving: list[Instance]) -> bool:
        if importlib.util.find_spec("numba") is None:
            return False
        moved, kept = (sum(instance.count for instance in part) for part in (moving, still))
        return kept > 0 and moved <= WORTH_A_BACKDROP * (moved + kept)

    def _make_backdrop(self, still: list[Instance], camera: Camera, sky: bool):
        from .backdrop import Backdrop

        background = scene_render.tensor(scene_render.behind(self._scene, camera)) if sky else None
        *splats, labels = self._splats(still, camera)
        return Backdrop(
            *splats, camera, background, labels=labels, settings=RasterSettings(near_plane=self._scene.near_plane)
        )

    def _splats(self, instances: list[Instance], camera: Camera) -> tuple[torch.Tensor, ...]:
        """Means, quats, scales, opacities, colours and object ids."""
        posed = self._pose(instances)
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

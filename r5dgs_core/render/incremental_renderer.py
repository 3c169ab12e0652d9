"""Incremental rendering of scenes with one camera: instances that have not moved since the last frame are reused.

Moving instances are detected from the frames themselves. The first frame after a change of camera, background or
visible instances renders everything. From the next frame on, the instances that have not moved form a static layer, and
only instances that have moved at least once are drawn into it. The images equal those of
`scene_renderer.render_frame`.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from .. import timing
from ..raster import backends, rasterize
from ..raster.backend import StaticLayer
from ..raster.settings import RasterSettings, RenderOutput
from ..scene.cameras import Camera
from ..scene.instance import Instance, Sky
from ..scene.scene import NEAR_PLANE, Scene
from . import coverage, posed_scene, scene_renderer

OWN_SKY = Sky()  # of the first scene
MAX_MOVING_SHARE = 0.7  # maximum share of moving Gaussians; above it, the static layer costs more than it saves


class IncrementalRenderer:
    """Renderer of frame sequences of one or several scenes in one world, on the CPU in float32. Thread-safe.

    Args:
        scenes: Scenes that the instances refer to.

    Attributes:
        ms_motion: Time spent posing Gaussians in the last frame, milliseconds.
    """

    def __init__(self, scenes: Scene | Sequence[Scene]):
        self.ms_motion = 0.0
        self._lock = threading.Lock()
        self._scenes = [scenes] if isinstance(scenes, Scene) else list(scenes)
        self._joined = posed_scene.join_scenes(self._scenes)
        self._shown: tuple | None = None  # camera, background, ranges and tints of the last frame
        self._pose_keys: list[np.ndarray] = []  # first pose of each instance
        self._moving: set[int] = set()
        self._static_layer: StaticLayer | None = None
        self._backend = backends.on_cpu()

    def render(
        self,
        instances: Sequence[Instance],
        camera: Camera,
        *,
        sky: Sky | None = OWN_SKY,
        near: float | None = None,
        distance: float = 0.0,
    ) -> RenderOutput:
        """Render ranges of the scenes' Gaussians, each transformed by its own matrix.

        Args:
            instances: As for `posed_scene.pose_instances`; compared one by one with those of the last frame.
            camera: The camera, in the world of the picture.
            sky: Sky behind everything; None for black.
            near: Near plane: Gaussians whose centre has a smaller depth are culled. None for the smallest near plane of
                the scenes with an instance, in this world's units.
            distance: Depth in front of the camera at which the returned depths start. It keeps the depths of a very
                distant camera precise.

        Returns:
            Colour (not clamped at 1), alpha, depth and, as ``ids``, the instance with the largest share of each pixel,
            -1 if the pixel is nearly empty; arrays. Hold-outs are black in the colour, and
            ``holdout`` is their share of each pixel; alpha, depth and ids describe the other instances only.

        Raises:
            ValueError: As for `posed_scene.pose_instances`.
        """
        with self._lock:
            try:
                return self._render(instances, camera, sky, near, distance)
            except ValueError:
                self._shown = None
                posed_scene.pose_instances(self._joined, instances)  # raises again, with the caller's numbering
                raise

    def coverage(
        self,
        instances: Sequence[Instance],
        groups: Sequence[int],
        camera: Camera,
        *,
        ranks: int,
        near: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the groups of instances with the largest shares of each pixel.

        Args:
            instances: As for `render`.
            groups: Group of each instance, -1 for none.
            camera: The camera, in the world of the picture.
            ranks: Number of groups to keep per pixel.
            near: As for `render`.

        Returns:
            Groups and shares, as in `coverage.shares`. [H, W, ranks] each
        """
        with self._lock:
            settings = RasterSettings(near_plane=self._near(instances) if near is None else near)
            labels = np.repeat(np.asarray(groups, np.int64), [instance.count for instance in instances])
            return coverage.shares(self._pose(instances), labels, camera, ranks=ranks, settings=settings)

    def posed(
        self, instances: Sequence[Instance], near: float | None = None
    ) -> tuple[posed_scene.PosedScene, RasterSettings]:
        """Return the Gaussians of instances in the world, and the settings that `render` draws them with."""
        with self._lock:
            settings = RasterSettings(near_plane=self._near(instances) if near is None else near)
            return self._pose(instances), settings

    def _render(
        self, instances: Sequence[Instance], camera: Camera, sky: Sky | None, near: float | None, distance: float
    ) -> RenderOutput:
        self.ms_motion = 0.0
        settings = RasterSettings(near_plane=self._near(instances) if near is None else near)
        view = (
            camera.width,
            camera.height,
            camera.intrinsics.tobytes(),
            camera.T_cam_world.tobytes(),
            settings,
            distance,
        )
        behind = None if sky is None else (sky.scene, np.asarray(sky.matrix, np.float64).tobytes())
        if any(one.holdout for one in instances):
            self._shown = None
            return self._render_all(instances, camera, sky, settings, distance)
        shown = (view, behind, tuple((one.scene, one.start, one.count, _tint_key(one)) for one in instances))
        if shown != self._shown:
            self._shown, self._static_layer, self._moving = shown, None, set()
            self._pose_keys = [self._pose_key(instance) for instance in instances]
            return self._render_all(instances, camera, sky, settings, distance)
        left = {i for i, one in enumerate(instances) if not np.array_equal(self._pose_key(one), self._pose_keys[i])}
        if not left <= self._moving:
            self._moving |= left
            self._static_layer = None
        moving = [i for i in range(len(instances)) if i in self._moving]
        still = [i for i in range(len(instances)) if i not in self._moving]
        if not self._wants_static_layer(instances, still, moving):
            return self._render_all(instances, camera, sky, settings, distance)
        if self._static_layer is None:
            self._static_layer = self._make_static_layer(instances, still, camera, sky, settings, distance)
        means, quats, scales, opacities, colors, labels = self._splats(instances, moving, camera, distance)
        picture = self._static_layer.draw(
            means, quats, scales, opacities, colors, labels=labels, ranks=_ranks(instances, moving)
        )
        depth = _mean(picture.image[..., 3], picture.alpha) if distance else picture.depth
        return RenderOutput(picture.image[..., :3], picture.alpha, depth, None, picture.ids)

    def _pose_key(self, instance: Instance) -> np.ndarray:
        """Pose of an instance: its matrix, its world matrix, and its time if it has residuals. [33]"""
        world = np.eye(4) if instance.world is None else instance.world
        t = np.array([instance.t if posed_scene.has_residuals(self._joined, instance) else np.inf], np.float64)
        return np.concatenate([np.ravel(instance.matrix), np.ravel(world), t]).astype(np.float64)

    def _near(self, instances: Sequence[Instance]) -> float:
        """Return the smallest near plane of the scenes with an instance, in units of the picture's world."""
        planes = {
            self._scenes[one.scene].near_plane * _scale(one)
            for one in instances
            if 0 <= one.scene < len(self._scenes)  # `pose_instances` reports other indices
        }
        return min((plane for plane in planes if plane > 0), default=NEAR_PLANE)

    def _sky(self, sky: Sky | None, camera: Camera) -> np.ndarray | None:
        if sky is None:
            return None
        if not 0 <= sky.scene < len(self._scenes):
            raise ValueError(f"sky: expected a scene below {len(self._scenes)}, got {sky.scene}")
        scene, turned = self._scenes[sky.scene], scene_renderer.sky_camera(camera, sky.matrix)
        return np.asarray(scene_renderer.behind(scene, turned), np.float32)

    def _wants_static_layer(self, instances: Sequence[Instance], still: list[int], moving: list[int]) -> bool:
        if not self._backend.has_static_layer:
            return False
        moved, kept = (sum(instances[i].count for i in part) for part in (moving, still))
        return kept > 0 and moved <= MAX_MOVING_SHARE * (moved + kept)

    def _make_static_layer(
        self,
        instances: Sequence[Instance],
        still: list[int],
        camera: Camera,
        sky: Sky | None,
        settings: RasterSettings,
        distance: float,
    ) -> StaticLayer:
        means, quats, scales, opacities, channels, labels = self._splats(instances, still, camera, distance)
        background = self._sky(sky, camera)
        if background is not None and distance:
            background = np.concatenate([background, np.zeros_like(background[..., :1])], -1)
        return self._backend.static_layer(
            means, quats, scales, opacities, channels, camera, background,
            labels=labels, ranks=_ranks(instances, still), settings=settings,
        )  # fmt: skip

    def _splats(
        self, instances: Sequence[Instance], part: list[int], camera: Camera, distance: float
    ) -> tuple[np.ndarray, ...]:
        """Means, quats, scales, opacities, channels and owners of some instances; channels are colours, then depths."""
        posed = self._pose([instances[i] for i in part])
        gaussians = scene_renderer.PosedGaussians(posed)
        channels = scene_renderer.colors(posed, camera)
        if distance:
            channels = np.concatenate([channels, _depths(posed, camera, distance)], 1)
        labels = _owners(instances, part)
        return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, channels, labels

    def _render_all(
        self,
        instances: Sequence[Instance],
        camera: Camera,
        sky: Sky | None,
        settings: RasterSettings,
        distance: float,
    ) -> RenderOutput:
        posed = self._pose(instances)
        gaussians = scene_renderer.PosedGaussians(posed)
        gaussians.object_ids = _owners(instances, range(len(instances)))
        colors = scene_renderer.colors(posed, camera)
        held = np.array([one.holdout for one in instances]) if any(one.holdout for one in instances) else None
        features = _depths(posed, camera, distance) if distance or held is not None else None
        if held is not None and features is not None:
            hidden = held[gaussians.object_ids][:, None]
            colors, features = colors * ~hidden, np.concatenate([features * ~hidden, hidden], 1)
        found = rasterize(
            gaussians,
            camera,
            features,
            background=self._sky(sky, camera),
            colors=colors,
            settings=settings,
        )
        if found.features is None or features is None:
            return found
        alpha, ids, holdout = found.alpha, found.ids, None
        if held is not None and ids is not None:
            holdout = found.features[..., 1]
            alpha, ids = np.maximum(alpha - holdout, 0), np.where((ids >= 0) & held[ids], np.int32(-1), ids)
        depth = _mean(found.features[..., 0], alpha)
        return RenderOutput(found.color, alpha, depth, None, ids, holdout)

    def _pose(self, instances: Sequence[Instance]) -> posed_scene.PosedScene:
        watch = timing.Stopwatch()
        posed = posed_scene.pose_instances(self._joined, instances)
        self.ms_motion += watch.lap()
        return posed


def _depths(posed: posed_scene.PosedScene, camera: Camera, distance: float) -> np.ndarray:
    """Depths of centres minus ``distance``, computed in float64. [N, 1] float32"""
    depths = (posed.means + posed.origin) @ camera.T_cam_world[2, :3] + (camera.T_cam_world[2, 3] - distance)
    return np.asarray(depths[:, None], np.float32)


def _mean(blended: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Divide a blend without background by its alpha; 0 if alpha is 0. [H, W]"""
    return np.divide(blended, alpha, out=np.zeros_like(blended), where=alpha > 0)


def _tint_key(instance: Instance) -> tuple | None:
    return None if instance.tint is None else tuple(instance.tint)


def _scale(instance: Instance) -> float:
    """Units of the picture's world per unit of the scene's, averaged over all directions; NaN for a NaN matrix."""
    if instance.world is None:
        return 1.0
    return float(abs(np.linalg.det(np.asarray(instance.world, np.float64)[:3, :3])) ** (1 / 3))


def _owners(instances: Sequence[Instance], part: Sequence[int]) -> np.ndarray:
    """Instance that each Gaussian of some instances belongs to. [n] int32"""
    return np.repeat(np.asarray(part, np.int32), [instances[i].count for i in part])


def _ranks(instances: Sequence[Instance], part: list[int]) -> np.ndarray:
    """Index of each Gaussian of some instances among the Gaussians of all instances. [n]"""
    starts = np.cumsum([0, *(instance.count for instance in instances)])
    return np.concatenate([np.arange(starts[i], starts[i + 1]) for i in part] or [np.arange(0)])

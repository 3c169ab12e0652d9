"""Pictures of a scene for films: a part of its objects, supersampling, alpha, and layers for compositors."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from ..playback import scene_player
from ..raster import RasterSettings, RenderOutput
from ..render import coverage, posed_scene, scene_renderer
from ..scene import cameras
from ..scene.cameras import Camera
from ..scene.scene import Scene

NOTHING = 1e10  # depth of empty pixels, as in Blender
SOLID = 0.5  # minimum alpha of pixels that have a depth and an object
RANKS = 6  # objects per pixel in Cryptomatte layers
SAMPLE_BYTES, LAYER_BYTES = 45, 148  # measured memory of a picture per sample, and of layers per pixel


@dataclass(frozen=True)
class Layers:
    """Layers of a picture, without supersampling.

    Attributes:
        depth: z in the camera frame, world units; `NOTHING` if the pixel is nearly empty. [H, W] float32
        index: Object id, 0 for background. [H, W] int32
        alpha: Coverage by Gaussians. [H, W] float32
        objects: Ids of the objects with the largest shares of each pixel, -1 for none. [H, W, RANKS] int32
        shares: Their shares, descending. [H, W, RANKS] float32
    """

    depth: np.ndarray
    index: np.ndarray
    alpha: np.ndarray
    objects: np.ndarray
    shares: np.ndarray


class FrameRenderer:
    """Renderer of frames of one scene.

    Args:
        scene: The scene.
        mode: Playback mode past t_max.
        rows: Gaussians to draw; None for all. [n] int
        samples: Supersampling: the picture is drawn at this multiple of its width and height, and averaged.
        transparent: True to leave out the sky.
    """

    def __init__(
        self,
        scene: Scene,
        mode: str = "rigid",
        *,
        rows: np.ndarray | None = None,
        samples: int = 1,
        transparent: bool = False,
    ):
        self._scene, self._player = scene, scene_player.Player(scene, mode)
        self._rows, self._samples, self._transparent = rows, samples, transparent

    def picture(self, camera: Camera, t: float) -> np.ndarray:
        """Return display-referred sRGB, not limited at 1, and straight alpha, 1 with a sky. [H, W, 4] float32"""
        fine = cameras.resize(camera, self._samples * camera.width, self._samples * camera.height)
        output = self._render(self._posed(camera, t), fine)
        alpha = np.clip(output.alpha, 0, 1) if self._transparent else np.ones_like(output.alpha)
        pixels = _averaged(np.concatenate([output.color, alpha[..., None]], -1), self._samples)
        if self._transparent:  # the colour is blended over black
            share = pixels[..., 3:]
            pixels[..., :3] = np.divide(pixels[..., :3], share, out=np.zeros_like(pixels[..., :3]), where=share > 1e-6)
        return pixels

    def layers(self, camera: Camera, t: float) -> Layers:
        """Return the layers of a picture."""
        posed = self._posed(camera, t)
        output = self._render(posed, camera)
        solid = output.alpha >= SOLID
        settings = RasterSettings(near_plane=self._scene.near_plane)
        groups = np.maximum(posed.object_ids, 0)
        objects, shares = coverage.shares(posed, groups, camera, ranks=RANKS, settings=settings)
        return Layers(
            depth=np.where(solid, output.depth, np.float32(NOTHING)).astype(np.float32),
            index=np.maximum(output.ids, 0),
            alpha=np.clip(output.alpha, 0, 1).astype(np.float32),
            objects=objects,
            shares=shares,
        )

    def _posed(self, camera: Camera, t: float) -> posed_scene.PosedScene:
        posed = posed_scene.pose_frame(self._scene, self._player.frame(t, camera.center))
        return posed if self._rows is None else posed_scene.rows_of(posed, self._rows)

    def _render(self, posed: posed_scene.PosedScene, camera: Camera) -> RenderOutput:
        background = None if self._transparent else "scene"
        return scene_renderer.render_frame(self._scene, posed, camera, background=background)


def memory(width: int, height: int, *, samples: int = 1, layers: bool = False) -> int:
    """Return the memory that drawing a picture needs besides the scene, bytes."""
    return width * height * max(SAMPLE_BYTES * samples**2, LAYER_BYTES if layers else 0)


def rows_of(
    scene: Scene, shown: Collection[int] | None = None, hidden: Collection[int] | None = None
) -> np.ndarray | None:
    """Return the Gaussians of some objects. [n] int

    Args:
        scene: The scene.
        shown: Objects to show; None for all.
        hidden: Objects to leave out, with their shadows.

    Returns:
        The rows, or None for all.
    """
    if shown is None and hidden is None:
        return None
    object_ids = scene.gaussians.object_ids
    kept = np.ones(len(object_ids), bool) if shown is None else np.isin(object_ids, list(shown))
    if hidden is not None:
        owners = np.array([group.object_id if group.role != "pinned" else -2 for group in scene.groups])
        moved_by = owners[scene.gaussians.motion_ids]
        kept &= ~np.isin(object_ids, list(hidden))
        kept &= ~((object_ids < 1) & np.isin(moved_by, list(hidden)))
    return np.flatnonzero(kept)


def _averaged(pixels: np.ndarray, samples: int) -> np.ndarray:
    """Return means over squares of ``samples`` pixels. [s H, s W, C] -> [H, W, C] float32"""
    if samples == 1:
        return np.asarray(pixels, np.float32)
    height, width, channels = pixels.shape
    squares = pixels.reshape(height // samples, samples, width // samples, samples, channels)
    return squares.mean((1, 3), dtype=np.float32)

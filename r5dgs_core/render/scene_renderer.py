"""Renderer of posed scenes, shared by evaluation, the worker and export.

Colour of a Gaussian: tint * max(0, 0.5 + SH(A^-1 d)) * max(0, shading factor), as in training. d is the viewing
direction in the world and A the map that moved the Gaussian from its bind state. The background is the scene's sky:
the spherical harmonics `Scene.background_sh` along each pixel's ray, clamped to [0, 1] as in training.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..playback import scene_player
from ..raster import RasterSettings, RenderOutput, rasterize, shade
from ..scene import cameras, spherical_harmonics
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import posed_scene
from .posed_scene import PosedScene


def render_frame(
    scene: Scene,
    pose: scene_player.Frame | PosedScene,
    camera: Camera,
    *,
    background: str | np.ndarray | None = "scene",
    backend: str = "auto",
    features: np.ndarray | None = None,
    settings: RasterSettings | None = None,
) -> RenderOutput:
    """Render a scene in a pose.

    Args:
        scene: The scene; its sky is the background.
        pose: A frame of `scene_player`, or the result of `pose_frame` or `pose_instances`.
        camera: The camera, in the scene's world.
        background: "scene" for the sky, None for black, or a colour [3] or image [H, W, 3].
        backend: Rasterizer: "auto", "cpu", "cuda" or "reference".
        features: Channels to blend besides the colour. [N, F]
        settings: Rasterizer settings; None for the defaults with the scene's near plane.

    Returns:
        Colour (not clamped at 1), alpha, depth, features and object ids, arrays.
    """
    posed = posed_scene.pose_frame(scene, pose) if isinstance(pose, scene_player.Frame) else pose
    if isinstance(background, str):
        if background != "scene":
            raise ValueError(f"background: expected 'scene', None or an array, got {background!r}")
        background = behind(scene, camera)
    return rasterize(
        PosedGaussians(posed),
        cameras.translated(camera, -posed.origin),
        None if features is None else np.asarray(features, np.float32),
        None if background is None else np.asarray(background, np.float32),
        colors=colors(posed, camera),
        settings=settings or RasterSettings(near_plane=scene.near_plane),
        backend=backend,
    )


def render_window(
    scene: Scene, pose: scene_player.Frame | PosedScene, camera: Camera, rows: slice, columns: slice
) -> RenderOutput:
    """Render a part of a picture, a rectangle of its rows and columns; other arguments as in `render_frame`."""
    width, height = columns.stop - columns.start, rows.stop - rows.start
    usual = RasterSettings(near_plane=scene.near_plane)
    # Gaussians beside the part are linearised where the whole picture linearises them.
    slack = (2 + usual.frustum_slack) * max(camera.width / width, camera.height / height)
    settings = dataclasses.replace(usual, frustum_slack=slack)
    part = cameras.crop(camera, columns.start, rows.start, width, height)
    return render_frame(scene, pose, part, settings=settings)


def render(player: scene_player.Player, camera: Camera, t: float, **options: Any) -> RenderOutput:
    """Render a player's scene at a time, with centres relative to the camera, near which float32 is most precise.

    Args:
        player: The scene in a mode.
        camera: The camera, in the scene's world.
        t: Scene time; may exceed t_max.
        options: Keyword arguments of `render_frame`.

    Returns:
        As `render_frame`.
    """
    return render_frame(player.scene, player.frame(t, camera.center), camera, **options)


def sky(scene: Scene, camera: Camera) -> np.ndarray:
    """Return the scene's background for a camera, display-referred sRGB. [H, W, 3] float32"""
    return shade.sky(scene.background_sh, camera)


def sky_camera(camera: Camera, matrix: np.ndarray) -> Camera:
    """Transform a camera into another world, for viewing directions only.

    Args:
        camera: The camera.
        matrix: Affine map from that world to the camera's; its translation is ignored. [4, 4]

    Returns:
        A camera for `sky` only: its transform is rigid only if the map is a rotation.

    Raises:
        ValueError: The matrix is singular or not finite.
    """
    linear, _ = posed_scene.affine(matrix, 0)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = camera.T_cam_world[:3, :3] @ np.linalg.inv(linear).T
    return dataclasses.replace(camera, T_cam_world=T_cam_world)


def colors(posed: PosedScene, camera: Camera) -> np.ndarray:
    """Return the display-referred colour of each Gaussian for a camera, >= 0. [N, 3] float32"""
    factor = posed.shading_factor
    if posed.sh.shape[1] == 1:
        rgb = np.maximum(spherical_harmonics.dc_to_rgb(np.asarray(posed.sh[:, 0], np.float32)), 0)
        if factor is not None:
            for channel in range(3):  # by column, as numpy is slow on rows of three
                rgb[:, channel] *= factor
    else:
        rgb = shade.seen_colors(
            np.asarray(posed.means, np.float32),
            np.asarray(posed.sh, np.float32),
            camera.center - posed.origin,
            view_maps=posed.view_maps,
            pose_ids=posed.pose_ids,
            factor=None if factor is None else np.asarray(factor, np.float32),
        )
    if posed.tints is not None:  # commutes with the clamp at 0, as tints are >= 0
        for channel in range(3):
            rgb[:, channel] *= posed.tints[:, channel][posed.pose_ids]
    return rgb


def behind(scene: Scene, camera: Camera) -> np.ndarray:
    """Return `sky`, or a single colour if the sky is constant. [3] or [H, W, 3]"""
    image = sky(scene, camera)
    return image[0, 0] if len(scene.background_sh) == 1 else image


class PosedGaussians:
    """Rasterizer inputs of a posed scene, except colours."""

    def __init__(self, posed: PosedScene):
        self.means = np.asarray(posed.means, np.float32)
        self.quats = np.asarray(posed.quats, np.float32)
        self.scales = np.asarray(np.exp(posed.log_scales), np.float32)
        with np.errstate(over="ignore"):
            self.opacities = np.asarray(1 / (1 + np.exp(-posed.opacity_logits)), np.float32)
        self.object_ids = posed.object_ids

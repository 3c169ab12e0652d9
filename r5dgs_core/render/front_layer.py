"""Image of the Gaussians in front of meshes, that is, between the camera and the nearest surface of each pixel.

A Gaussian is weighted by the share of its density along the pixel's ray that lies in front of the surface, so a
Gaussian that a surface cuts fades out across it. The image is composited over the render of the meshes, whose
coverage anti-aliases the edges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..motion import rotations
from ..raster.cpu import blend_before_depths, forward, projection, tiles
from ..raster.settings import RasterSettings
from ..raster.thread_pool import run
from ..scene import cameras, spherical_harmonics
from ..scene.cameras import Camera
from ..scene.instance import Instance
from ..scene.scene import Scene
from . import scene_renderer
from .posed_scene import PosedScene

THINNEST = 1e-3  # lower limit of the ratio of two axes of a Gaussian, for its extent in depth
SKY_TOLERANCE = 0.1  # maximum difference of colour from the sky, per channel, of a Gaussian of the sky
SKY_LOGIT = 0.0  # opacity logit below which a Gaussian of the sky's colour belongs to the sky at any distance


def render(
    posed: PosedScene,
    camera: Camera,
    meshes: np.ndarray,
    settings: RasterSettings,
    without: np.ndarray | None = None,
) -> np.ndarray:
    """Return the layer of the Gaussians in front of meshes.

    Args:
        posed: Gaussians in the world.
        camera: The camera, in the same world.
        meshes: Depth of the nearest mesh at each pixel, infinite for none; see `mesh_depths.draw`. [H, W]
        settings: Rasterizer settings.
        without: True for Gaussians to leave out, or None. [N]

    Returns:
        Display-referred colours premultiplied by alpha, and alpha; zero in pixels without a mesh. [H, W, 4] float32
    """
    layer = np.zeros((camera.height, camera.width, 4), np.float32)
    if not len(posed.means) or not np.isfinite(meshes).any():
        return layer
    colors = np.ascontiguousarray(scene_renderer.colors(posed, camera), np.float32)
    gaussians, seen = scene_renderer.PosedGaussians(posed), cameras.translated(camera, -posed.origin)
    if without is not None:
        gaussians.opacities = np.where(without, np.float32(0), gaussians.opacities)
    rows = projection.padded_rows(len(gaussians.means))
    geometry, depths = forward.aligned((rows, projection.GEOMETRY), np.float64), np.empty(rows)
    boxes, radii = np.empty(rows), np.empty(rows, np.float32)
    arrays = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    forward.project(forward.pack_view(seen, settings), arrays, geometry, depths, boxes, radii)
    order = tiles.sort_by_depth(depths, radii)
    run(
        blend_before_depths.blend, camera.height // 32,
        geometry[order], _along_rays(gaussians, seen, order), colors[order], np.linalg.inv(camera.intrinsics), meshes,
        settings.alpha_min, settings.alpha_max, settings.finished_at, layer,
    )  # fmt: skip
    return layer


def sky_mask(scenes: Sequence[Scene], instances: Sequence[Instance], posed: PosedScene, camera: Camera) -> np.ndarray:
    """Return a mask of the Gaussians that represent the sky; meshes are always in front of them.

    These are background or unassigned Gaussians with the colour of the sky behind them that are faint, or farther from
    the middle of their scene than all its cameras.

    Args:
        scenes: Scenes that the instances refer to.
        instances: The instances.
        posed: Their Gaussians in the world.
        camera: The camera, in the same world.

    Returns:
        The mask. [N]
    """
    result, end = np.zeros(len(posed.means), bool), 0
    colors = scene_renderer.colors(posed, camera)
    for instance in instances:
        start, end = end, end + instance.count
        rows = start + np.flatnonzero(posed.object_ids[start:end] <= 0)
        if not len(rows):
            continue
        scene = scenes[instance.scene]
        world = np.eye(4) if instance.world is None else np.asarray(instance.world, np.float64)
        rays = (posed.means[rows] + posed.origin - camera.center) @ np.linalg.inv(world[:3, :3]).T
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-30)
        skies = np.clip(spherical_harmonics.to_rgb(scene.background_sh, rays), 0, 1)
        alike = (np.abs(colors[rows] - skies) < SKY_TOLERANCE).all(axis=1)
        faint = posed.opacity_logits[rows] < SKY_LOGIT
        result[rows] = alike & (faint | _is_beyond(scene, scene.gaussians.means[instance.start + rows - start]))
    return result


def _is_beyond(scene: Scene, means: np.ndarray) -> np.ndarray:
    """Mask of points farther from the middle of a scene than all its cameras. [n]"""
    if not scene.cameras:
        return np.zeros(len(means), bool)
    middle = np.median(scene.gaussians.means, axis=0)
    farthest = max(float(np.linalg.norm(camera.center - middle)) for camera in scene.cameras)
    return np.linalg.norm(means - middle, axis=1) > farthest


def _along_rays(gaussians: scene_renderer.PosedGaussians, camera: Camera, rows: np.ndarray) -> np.ndarray:
    """Quadratic forms of the exponents along rays through the camera, in its frame.

    The exponent at the depth z of a ray r is -(z^2 r.A r - 2 z r.b) / 2 plus a constant.

    Returns:
        A as xx, xy, xz, yy, yz, zz, and b. [n, 9]
    """
    T = camera.T_cam_world
    scales = gaussians.scales[rows].astype(np.float64)
    inverse = 1 / np.maximum(scales, THINNEST * scales.max(axis=1, keepdims=True))
    frames = T[:3, :3] @ rotations.quats_to_rotmats(rotations.normalize(gaussians.quats[rows].astype(np.float64)))
    axes = frames * inverse[:, None, :]
    forms = axes @ np.swapaxes(axes, 1, 2)
    centers = gaussians.means[rows].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    upper = forms[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    return np.ascontiguousarray(np.concatenate([upper, np.einsum("nij,nj->ni", forms, centers)], 1))

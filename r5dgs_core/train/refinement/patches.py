"""Small planar patches of the scene that several pictures of one time show.

The trained scene gives a patch its first depth and slope, and the pictures that show it. All measurements are between
images, which do not adapt to wrong cameras as a trained scene does.

Notation: P patches, M pairs of a patch and another picture that shows it, N pixels of a patch. The inverse depth of a
plane is linear in the pixel: at (du, dv) from the centre of a patch it is (1, du, dv) times its three numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...scene import cameras
from ...scene.cameras import Camera

RADIUS = 3  # of a patch, px
BLUR = 0.7  # standard deviation of the smoothing of the images, px
CELL, BORDER = 6, 6  # least distance of two patches, and of a patch from the border, px
CONTRAST = 2e-5  # least mean squared slope of a patch
EDGE = 0.05  # weight of the contrast of an edge relative to that of a corner
FLAT = 0.02  # largest deviation of a patch from its plane, relative to its depth
HIDDEN = 0.02  # difference from the depth of the scene at which a patch is hidden, relative
UNEVEN = 0.4  # largest squared change of the motion in time, relative to the motion
NOISY = 4.0  # the same, relative to its median over the image, below which it is noise
OPAQUE = 0.9  # least opacity of the scene at a patch
NEIGHBOURS = 6  # pictures that show a patch and are compared, at most

_GRID = np.arange(-RADIUS, RADIUS + 1.0)
OFFSETS = np.stack([axis.ravel() for axis in np.meshgrid(_GRID, _GRID)], 1)  # (du, dv) of the pixels. [N, 2]
PLANE = np.concatenate([np.ones((len(OFFSETS), 1)), OFFSETS], 1)  # [N, 3]


@dataclass(frozen=True, eq=False)
class DepthView:
    """An image and the depth of the scene in it.

    Attributes:
        pose: Row of its camera.
        moment: Number of its time; pictures of one moment are compared.
        t: Its time as given.
        layers: Colours, their slopes along x and y (per px), and along time, 0 for moving surfaces. [12, H, W] float32
        inverse: Inverse depth of the scene; 0 if it is unknown, or if colours change too fast for a slope. [H, W]
        velocity: Velocity of the surface, world frame; 0 if it is at rest or unknown. [H, W, 3]
    """

    pose: int
    moment: int
    t: float
    layers: np.ndarray
    inverse: np.ndarray
    velocity: np.ndarray


def depth_view(
    pose: int,
    moment: int,
    t: float,
    images: Sequence[np.ndarray],
    span: float,
    depth: np.ndarray,
    velocity: np.ndarray,
    known: np.ndarray,
) -> DepthView:
    """Return an image with its slopes, and the depth and velocity of the scene.

    Args:
        pose, moment, t: As in `DepthView`.
        images: The previous image, the image, and the next one, in the scene's colours. [H, W, 3] each
        span: Time between the previous and the next image; 0 if there are none.
        depth: Depth of the scene. [H, W]
        velocity: As in `DepthView`.
        known: Pixels at which image and depth are known. [H, W] bool
    """
    before, image, after = (ndimage.gaussian_filter(one.astype(np.float32), (BLUR, BLUR, 0)) for one in images)
    by_y, by_x = np.gradient(image, axis=(0, 1))
    by_time = (after - before) / span if span > 0 else np.zeros_like(image)
    moving = velocity.any(axis=2)  # `differences` moves these surfaces, so their colours need no slope in time
    by_time[moving] = 0
    layers = np.concatenate([image, by_x, by_y, by_time], axis=2).transpose(2, 0, 1)
    usable = known & (moving | ~_uneven(before, image, after))
    inverse = np.where(usable, 1 / np.maximum(depth, 1e-6), 0.0)
    return DepthView(pose, moment, t, np.ascontiguousarray(layers, np.float32), inverse, velocity)


def _uneven(before: np.ndarray, image: np.ndarray, after: np.ndarray) -> np.ndarray:
    """True for pixels whose surroundings move too fast for a slope in time. [H, W]"""
    size = 2 * RADIUS + 1
    bend, motion = (
        ndimage.uniform_filter((part**2).sum(2), size) for part in (before + after - 2 * image, after - before)
    )
    return bend > UNEVEN * motion + NOISY * np.median(bend) + 1e-6


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches and the pictures that show them.

    Attributes:
        host: Image in which a patch is square. [P]
        centers: Its centre there, px. [P, 2]
        planes: Its inverse depth, which fits change. [P, 3]
        patch: Patch of each pair. [M]
        target: Other image of each pair. [M]
    """

    host: np.ndarray
    centers: np.ndarray
    planes: np.ndarray
    patch: np.ndarray
    target: np.ndarray


def find(depth_views: Sequence[DepthView], rig: Sequence[Camera], each: int) -> Patches:
    """Choose patches with contrast on surfaces, and pair them with the pictures that show them.

    Args:
        depth_views: The pictures.
        rig: Present camera of each pose.
        each: Number of patches of a picture, at most.
    """
    chosen = [_chosen(one, each) for one in depth_views]
    host = np.concatenate([np.full(len(centers), k) for k, (centers, _) in enumerate(chosen)])
    centers, planes = (np.concatenate([one[k] for one in chosen]) for k in (0, 1))
    patch, target = [], []
    for k, one in enumerate(depth_views):
        mine = np.flatnonzero(host == k)
        points = in_world(rig[one.pose], centers[mine], planes[mine, 0])
        ahead = rig[one.pose].forward
        others = [j for j, other in enumerate(depth_views) if j != k and other.moment == one.moment]
        count = np.zeros(len(mine), int)
        for j in sorted(others, key=lambda j: float(-ahead @ rig[depth_views[j].pose].forward)):
            seen = _shown(depth_views[j], rig[depth_views[j].pose], points) & (count < NEIGHBOURS)
            count += seen
            patch.append(mine[seen])
            target.append(np.full(int(seen.sum()), j))
    empty = np.zeros(0, int)
    return Patches(host, centers, planes, np.concatenate([empty, *patch]), np.concatenate([empty, *target]))


def _chosen(one: DepthView, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centres [P, 2] and planes [P, 3] of the patches of a picture, those with the most contrast first."""
    by_x, by_y = one.layers[3:6], one.layers[6:9]
    size = 2 * RADIUS + 1
    xx, yy, xy = (ndimage.uniform_filter(part.sum(0), size) for part in (by_x**2, by_y**2, by_x * by_y))
    corner = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    score = corner + EDGE * (xx + yy)
    surface = np.asarray(ndimage.binary_erosion(one.inverse > 0, iterations=RADIUS + 2), bool)
    score[~surface] = 0
    inside = np.zeros_like(score, bool)
    inside[BORDER:-BORDER, BORDER:-BORDER] = True
    peaks = inside & (score == ndimage.maximum_filter(score, CELL)) & (score > CONTRAST)
    y, x = np.nonzero(peaks)
    order = np.argsort(-score[y, x], kind="stable")
    x, y = x[order], y[order]
    du, dv = OFFSETS.T.astype(int)
    window = one.inverse[y[:, None] + dv, x[:, None] + du]
    planes = window @ np.linalg.pinv(PLANE).T
    off = np.abs(window - planes @ PLANE.T).max(1, initial=0.0)
    flat = np.flatnonzero(off < FLAT * planes[:, 0])[:most]
    return np.stack([x, y], 1)[flat] + 0.5, planes[flat]


def _shown(one: DepthView, camera: Camera, points: np.ndarray) -> np.ndarray:
    """True for points that are inside a picture and not hidden there. [P]"""
    pixels, depth = cameras.project(camera, points)
    height, width = one.inverse.shape
    inside = (depth > 0) & (pixels > BORDER).all(1) & (pixels < [width - BORDER, height - BORDER]).all(1)
    x, y = np.where(inside[:, None], pixels, 0).astype(int).T
    return inside & (np.abs(one.inverse[y, x] * np.where(inside, depth, 0.0) - 1) < HIDDEN)


def in_camera(camera: Camera, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return the points at pixels [..., 2] with an inverse depth [...], camera frame. [..., 3]"""
    slopes = (pixels - camera.intrinsics[:2, 2]) / np.diag(camera.intrinsics)[:2]
    return np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], -1) / inverse[..., None]


def in_world(camera: Camera, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return the same points in the world. [..., 3]"""
    return (in_camera(camera, pixels, inverse) - camera.T_cam_world[:3, 3]) @ camera.T_cam_world[:3, :3]


# Columns of the slopes of a pair: pose and time of the host, pose and time of the target, plane.
HOST, TARGET, SHAPE = slice(0, 7), slice(7, 14), slice(14, 17)


@dataclass(frozen=True, eq=False)
class Placed:
    """A picture with the present state of its camera.

    Attributes:
        depth_view: The picture.
        camera: Corrected camera.
        pivot: Fixed point of its rotation, camera frame. [3]
        t: Corrected time.
    """

    depth_view: DepthView
    camera: Camera
    pivot: np.ndarray
    t: float


def differences(
    host: Placed, target: Placed, centers: np.ndarray, planes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare patches [M] of one picture with another picture.

    The mean colour of a patch does not count, nor the time between the pictures to first order: a patch moves with its
    velocity, or its colours change by their slope in time.

    Returns:
        Differences [M, 3 N], their slopes [M, 3 N, 17], and the correlation of each pair [M].
    """
    pixels = centers[:, None] + OFFSETS
    inverse = np.maximum(planes @ PLANE.T, 1e-6)
    p_host = in_camera(host.camera, pixels, inverse)
    turn = target.camera.T_cam_world[:3, :3] @ host.camera.T_cam_world[:3, :3].T
    col, row = (pixels - 0.5).astype(int).transpose(2, 0, 1)
    velocity = host.depth_view.velocity[row, col] @ target.camera.T_cam_world[:3, :3].T
    p = p_host @ turn.T + target.camera.T_cam_world[:3, 3] - turn @ host.camera.T_cam_world[:3, 3]
    p += velocity * (target.t - host.t)
    z = np.maximum(p[..., 2], 1e-6)
    focal = np.diag(target.camera.intrinsics)[:2]
    x, y = (p[..., :2] / z[..., None] * focal + target.camera.intrinsics[:2, 2] - 0.5).transpose(2, 0, 1)
    at = np.stack([y, x])
    layers = np.stack(
        [ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in target.depth_view.layers], -1
    )
    shown, by_x, by_y, by_time = np.split(layers, 4, axis=-1)  # [M, N, 3] each
    own = host.depth_view.layers[:, row, col].transpose(1, 2, 0)
    shown = shown + by_time * (host.t - target.t)
    shown, wanted = (one - one.mean(1, keepdims=True) for one in (shown, own[..., :3]))
    power = (shown**2).sum((1, 2)) * (wanted**2).sum((1, 2))
    correlation = (shown * wanted).sum((1, 2)) / np.sqrt(np.maximum(power, 1e-12))
    by_p = np.empty((*by_x.shape, 3))
    by_p[..., 0], by_p[..., 1] = by_x * (focal[0] / z)[..., None], by_y * (focal[1] / z)[..., None]
    by_p[..., 2] = -(by_p[..., 0] * (p[..., 0] / z)[..., None] + by_p[..., 1] * (p[..., 1] / z)[..., None])
    by_time = by_time - (by_p * velocity[:, :, None]).sum(-1)
    by_host = by_p @ turn
    slopes = np.empty((*by_x.shape, SHAPE.stop), np.float32)
    slopes[..., :3] = -np.cross((p_host - host.pivot)[:, :, None], by_host)
    slopes[..., 3:6], slopes[..., 6] = -by_host, by_time
    slopes[..., 7:10] = np.cross((p - target.pivot)[:, :, None], by_p)
    slopes[..., 10:13], slopes[..., 13] = by_p, -by_time
    along = -(by_host * p_host[:, :, None]).sum(-1) / inverse[..., None]
    slopes[..., SHAPE] = along[..., None] * PLANE[:, None]
    slopes -= slopes.mean(1, keepdims=True)
    count = len(centers)
    return (shown - wanted).reshape(count, -1), slopes.reshape(count, -1, SHAPE.stop), correlation

"""Pinhole cameras and conversions of their axes.

Core cameras are OpenCV: x right, y down, z forward; ``T_cam_world`` maps world points to camera space; pixel centres
are at +0.5. Blender and the D-NeRF files use OpenGL axes (y up, looking along -z); this module converts between them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..motion import rotations

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# Rotation from a data set's world axes to Blender's (right-handed, Z up), applied once, on the root empty.
WORLD_TO_BLENDER = {
    "blender": np.eye(3),
    "colmap": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "opengl": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
FARTHEST = 1e15  # maximum coordinate; its square is within the range of float32
MAX_SIDE = 1 << 16  # maximum image side
_MAX_FOCAL = 1e12  # pixels; the smallest focal length is its reciprocal
_RIGID_TOLERANCE = 1e-3  # maximum entry of R R^T - 1
_ROUNDING = 1e-9  # tolerance of matrix entries that must be 0 or 1
EXTENT = 3.0  # radius of a Gaussian in images, standard deviations
FAR = 1e4  # camera distance that replaces infinity for parallel projections, in half depth ranges


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV axes.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        intrinsics: Camera matrix in pixels, float64. [3, 3]
        T_cam_world: Rigid transform from world to camera, float64. [4, 4]
        name: Name of the view, unique within a data set, or "".
    """

    width: int
    height: int
    intrinsics: np.ndarray
    T_cam_world: np.ndarray
    name: str = ""

    @property
    def center(self) -> np.ndarray:
        """Position in the world. [3]"""
        return -self.T_cam_world[:3, :3].T @ self.T_cam_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """Viewing direction in the world, unit. [3]"""
        return self.T_cam_world[2, :3].copy()


def check(camera: Camera) -> None:
    """Raise ValueError or TypeError naming the entry that makes a camera unusable for rendering."""
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}")
    place = f"camera {camera.name!r}" if camera.name else "camera"
    if not all(isinstance(side, int | np.integer) for side in (camera.width, camera.height)):
        raise TypeError(f"{place}: expected whole numbers of pixels, got {camera.width!r} x {camera.height!r}")
    if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
        raise ValueError(
            f"{place}: expected a width and height of 1 to {MAX_SIDE}, got {camera.width} x {camera.height}"
        )
    for name, shape in (("intrinsics", (3, 3)), ("T_cam_world", (4, 4))):
        matrix = getattr(camera, name)
        if not isinstance(matrix, np.ndarray):
            raise TypeError(f"{place}: {name}: expected an array, got {type(matrix).__name__}; cameras get no gradient")
        if matrix.shape != shape:
            raise ValueError(f"{place}: {name}: expected shape {shape}, got {matrix.shape}")
        sound = np.abs(matrix) <= FARTHEST
        if not sound.all():
            at = tuple(np.argwhere(~sound)[0].tolist())
            raise ValueError(
                f"{place}: {name}: expected finite values, found {matrix[at]} at index {at} (largest: {FARTHEST:g})"
            )
        last = np.array([0.0] * (len(matrix) - 1) + [1.0])
        if not (np.abs(matrix[-1] - last) <= _ROUNDING).all():
            raise ValueError(f"{place}: {name}: expected {last.tolist()} as the last row, found {matrix[-1].tolist()}")
    rotation = camera.T_cam_world[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > _RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{place}: T_cam_world: expected a rotation in its first three rows and columns, found one that is off by "
            f"{off:.2g} or mirrors; remove scale and mirroring"
        )
    if abs(camera.intrinsics[1, 0]) > _ROUNDING:
        raise ValueError(f"{place}: intrinsics: expected 0 at index (1, 0), found {camera.intrinsics[1, 0]}")
    for at in ((0, 0), (1, 1)):
        if not 1 / _MAX_FOCAL <= camera.intrinsics[at] <= _MAX_FOCAL:
            raise ValueError(
                f"{place}: intrinsics: expected focal lengths above 0, up to {_MAX_FOCAL:g}, found "
                f"{camera.intrinsics[at]} at index {at}"
            )


def opengl_to_cam_world(matrix_world: np.ndarray) -> np.ndarray:
    """Convert a camera-to-world matrix with OpenGL axes to ``T_cam_world`` with OpenCV axes. [4, 4] -> [4, 4]"""
    T_world_cam = np.asarray(matrix_world, np.float64) @ OPENGL_TO_OPENCV
    rotation = T_world_cam[:3, :3] / np.linalg.norm(T_world_cam[:3, :3], axis=0)
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = rotation.T
    T_cam_world[:3, 3] = -rotation.T @ T_world_cam[:3, 3]
    return T_cam_world


def cam_world_to_opengl(T_cam_world: np.ndarray) -> np.ndarray:
    """Inverse of `opengl_to_cam_world`: camera to world, OpenGL camera axes. [4, 4] -> [4, 4]"""
    T_world_cam = np.linalg.inv(np.asarray(T_cam_world, np.float64))
    return T_world_cam @ OPENGL_TO_OPENCV


def from_projection(
    projection: np.ndarray,  # [4, 4]
    matrix_world: np.ndarray,  # [4, 4]
    width: int,
    height: int,
    depths: tuple[float, float] = (0.0, 1.0),
    name: str = "",
) -> tuple[Camera, float]:
    """Camera of an OpenGL projection.

    A parallel projection is approximated by a camera `FAR` half depth ranges away; the image differs by a small
    fraction of a pixel.

    Args:
        projection: Camera space to clip space, perspective or parallel, including sensor fit and shift. [4, 4]
        matrix_world: Camera to world, OpenGL camera axes. [4, 4]
        width: Image width in pixels.
        height: Image height in pixels.
        depths: Nearest and farthest relevant depth from ``matrix_world``; used only for parallel projections.
        name: Name of the camera.

    Returns:
        The camera, and its distance behind ``matrix_world``: 0 for perspective projections.
    """
    p = np.asarray(projection, np.float64)
    T_cam_world = opengl_to_cam_world(matrix_world)
    intrinsics = np.eye(3)
    if not is_parallel(p):
        intrinsics[0] = 0.5 * width * p[0, 0], 0.0, 0.5 * width * (1 - p[0, 2])
        intrinsics[1] = 0.0, 0.5 * height * p[1, 1], 0.5 * height * (1 + p[1, 2])
        return Camera(width, height, intrinsics, T_cam_world, name), 0.0
    middle, half = 0.5 * (depths[0] + depths[1]), 0.5 * (depths[1] - depths[0])
    away = FAR * max(half, 1e-3 * abs(middle), 1e-6)  # distance to the depth at which the scale is exact
    intrinsics[0] = 0.5 * width * p[0, 0] * away, 0.0, 0.5 * width * (1 + p[0, 3])
    intrinsics[1] = 0.0, 0.5 * height * p[1, 1] * away, 0.5 * height * (1 - p[1, 3])
    T_cam_world[2, 3] += away - middle
    return Camera(width, height, intrinsics, T_cam_world, name), away - middle


def is_parallel(projection: np.ndarray) -> bool:
    """Return True if an OpenGL projection is parallel, i.e. clip w is 1 instead of the depth. [4, 4]"""
    return bool(abs(projection[3, 3]) > 0.5)


def translated(camera: Camera, shift: np.ndarray) -> Camera:
    """Camera translated by a world vector; the same object if the vector is zero. [3]"""
    if not np.any(shift):
        return camera
    T_cam_world = camera.T_cam_world.copy()
    T_cam_world[:3, 3] -= T_cam_world[:3, :3] @ shift
    return dataclasses.replace(camera, T_cam_world=T_cam_world)


def crop(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Camera of a rectangle of the image, in pixels from the upper left corner; it may extend beyond the image."""
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= left, top
    return dataclasses.replace(camera, width=width, height=height, intrinsics=intrinsics)


def resize(camera: Camera, width: int, height: int) -> Camera:
    """Camera of the same image at another resolution."""
    intrinsics = camera.intrinsics.copy()
    intrinsics[0] *= width / camera.width
    intrinsics[1] *= height / camera.height
    return dataclasses.replace(camera, width=width, height=height, intrinsics=intrinsics)


def resized(camera: Camera, longest: int) -> Camera:
    """Resize a camera so that its longer side has ``longest`` pixels."""
    scale = longest / max(camera.width, camera.height)
    return resize(camera, max(round(scale * camera.width), 1), max(round(scale * camera.height), 1))


def reduced(camera: Camera, longest: int) -> Camera:
    """Resize a camera so that its longer side has at most ``longest`` pixels."""
    return resized(camera, min(longest, max(camera.width, camera.height)))


def reached_by(camera: Camera, points: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return a mask of the Gaussians that may reach a camera's image: within three standard deviations and 1 px.

    Args:
        camera: The camera.
        points: Their centres, world. [N, 3] float64
        scales: Their largest standard deviations. [N]
    """
    pixels, depth = project(camera, points)
    reach = EXTENT * scales * camera.intrinsics[0, 0] / np.maximum(depth, 1e-6) + 1
    outside = np.maximum(-pixels, pixels - [camera.width, camera.height]).max(1) > reach
    return ~outside & (depth > 0)


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points to the image.

    Args:
        camera: The camera.
        points: World points. [..., 3]

    Returns:
        Pixel coordinates (NaN behind the camera) [..., 2] and depth z in the camera frame [...].
    """
    p_cam = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    z = p_cam[..., 2]
    in_front = z > 1e-9 * np.abs(p_cam).max(axis=-1)  # independent of the world's unit
    uv = p_cam[..., :2] / np.where(in_front, z, np.nan)[..., None]
    k = camera.intrinsics
    pixels = np.stack([k[0, 0] * uv[..., 0] + k[0, 1] * uv[..., 1] + k[0, 2], k[1, 1] * uv[..., 1] + k[1, 2]], axis=-1)
    return pixels, z


def essential(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the essential matrix with x_other^T E x_one = 0 of world-to-camera transforms [4, 4]. [3, 3]"""
    relative = other @ np.linalg.inv(one)
    t = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    return rotations.skew(t) @ relative[:3, :3]


def fundamental(one: Camera, other: Camera) -> np.ndarray:
    """Return the fundamental matrix, which maps pixels (x, y, 1) of one camera to epipolar lines of another. [3, 3]"""
    between = essential(one.T_cam_world, other.T_cam_world)
    return np.linalg.inv(other.intrinsics).T @ between @ np.linalg.inv(one.intrinsics)


def pixel_rays(camera: Camera, rows: slice = slice(None)) -> np.ndarray:
    """Unit world directions through the centres of all pixels, or of those in some rows. [H, W, 3]"""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height)[rows] + 0.5)
    v = (y - k[1, 2]) / k[1, 1]
    u = (x - k[0, 2] - k[0, 1] * v) / k[0, 0]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ camera.T_cam_world[:3, :3]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

"""Attributes of point clouds, packed for the splat shader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core.color import srgb
from ...r5dgs_core.motion import rotations
from ...r5dgs_core.scene import spherical_harmonics
from ..scene import point_clouds

TEXELS = 4  # of each Gaussian in the table: position and group; covariance xx xy xz yy; yz zz; color and opacity
SHADED = 1  # further texels if any cloud has shading: vector and rest factor
BALL = 0.3  # size of points without `scale`, as a fraction of their mean distance on a surface
# Further texels of the coefficients by degree, three channels each, without gaps.
HARMONICS = {degree: -(-3 * ((degree + 1) ** 2 - 1) // 4) for degree in range(4)}


@dataclass(frozen=True)
class CloudData:
    """Gaussians of a point cloud, in its own frame.

    Attributes:
        positions: Centres. [n, 3] float32
        covariances: xx, xy, xz, yy, yz, zz. [n, 6] float32
        base: Degree-0 coefficients and opacity. [n, 4] float32
        harmonics: Coefficients of degree 1 and higher. [n, K - 1, 3] float32
        shading: Shading vector and rest factor, or None. [n, 4] float32
    """

    positions: np.ndarray
    covariances: np.ndarray
    base: np.ndarray
    harmonics: np.ndarray
    shading: np.ndarray | None

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return spherical_harmonics.degree_of(self.harmonics.shape[1] + 1)


def read(cloud: bpy.types.PointCloud, color: Sequence[float]) -> CloudData:
    """Read an evaluated point cloud.

    Points without size become small balls, and points without radiance get `display_color` or else the given color, so
    that the output of any node is visible. Gaussians with values that are not finite get opacity 0.

    Args:
        cloud: Evaluated point cloud.
        color: Linear color and opacity of points without any.
    """
    positions = _values(cloud, "position", "FLOAT_VECTOR", "vector", 3)
    if positions is None:
        positions = np.zeros((0, 3), np.float32)
    count = len(positions)
    scales = _values(cloud, "scale", "FLOAT_VECTOR", "vector", 3)
    quats = _values(cloud, "rotation", "QUATERNION", "value", 4)
    base = _values(cloud, "radiance:base", "FLOAT_COLOR", "color", 4)
    if scales is None:
        scales = np.full((count, 3), _ball(positions), np.float32)
    if quats is None:
        quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    if base is None:
        shown = _values(cloud, point_clouds.DISPLAY_COLOR, "FLOAT_COLOR", "color", 4)
        base = np.tile(np.float32(color), (count, 1)) if shown is None else shown
        base[:, :3] = (srgb.from_linear(base[:, :3].astype(np.float64)) - 0.5) / spherical_harmonics.C0
    covariances = _covariances(scales, quats)
    bad = ~np.isfinite(np.concatenate([positions, covariances, base], 1)).all(1)
    positions[bad], covariances[bad], base[bad] = 0, 0, 0
    return CloudData(positions, covariances, base, _harmonics(cloud), _shading(cloud))


def _values(cloud: bpy.types.PointCloud, name: str, kind: str, field: str, width: int) -> np.ndarray | None:
    """Values of an attribute, or None if it is missing. [n, width]"""
    found = point_clouds.attribute(cloud, name, kind)
    return None if found is None else point_clouds.read(found, field, width)


def _ball(positions: np.ndarray) -> float:
    """Standard deviation of points without size: a share of their spacing on a surface as large as the cloud."""
    places = positions[np.isfinite(positions).all(1)]
    size = float(np.linalg.norm(np.ptp(places.astype(np.float64), axis=0))) if len(places) > 1 else 0.0
    return BALL * size / np.sqrt(len(places)) if size else 1.0


def _covariances(scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Six entries of each covariance. [n, 3], [n, 4] -> [n, 6]"""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    units = np.where(lengths > 0, quats / np.maximum(lengths, 1e-30), np.float32([1, 0, 0, 0]))
    axes = rotations.quats_to_rotmats(units) * scales[:, None, :]
    full = axes @ axes.transpose(0, 2, 1)
    return np.ascontiguousarray(full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], np.float32)


def _harmonics(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Coefficients of the highest complete degree. [n, K - 1, 3]"""
    planes = []
    for k in range(15):
        found = point_clouds.attribute(cloud, f"{point_clouds.HARMONICS}{k}", "FLOAT_VECTOR")
        if found is None:
            break
        planes.append(point_clouds.read(found, "vector", 3))
    complete = max(count for count in (0, 3, 8, 15) if count <= len(planes))
    if complete == 0:
        return np.empty((len(cloud.points), 0, 3), np.float32)
    return np.nan_to_num(np.stack(planes[:complete], axis=1))


def _shading(cloud: bpy.types.PointCloud) -> np.ndarray | None:
    """Shading vector and rest factor of each point, or None. [n, 4]"""
    vector = point_clouds.attribute(cloud, point_clouds.SHADING, "FLOAT_VECTOR")
    rest = point_clouds.attribute(cloud, point_clouds.SHADING_REST, "FLOAT")
    if vector is None or rest is None:
        return None
    values = [point_clouds.read(vector, "vector", 3), point_clouds.read(rest, "value", 1)]
    return np.nan_to_num(np.concatenate(values, 1))


@dataclass(frozen=True)
class Table:
    """Gaussians of several groups in one table.

    Attributes:
        texels: Rows of four floats, as described above. [N, texels of a Gaussian, 4] float32
        positions: Centres. [N, 3] float32
        starts: First Gaussian of each group, and N. [G + 1]
        degree: Highest degree of the groups.
        shaded: True if any group has shading.
    """

    texels: np.ndarray
    positions: np.ndarray
    starts: tuple[int, ...]
    degree: int
    shaded: bool


def pack(clouds: Sequence[CloudData]) -> Table:
    """Concatenate clouds; the index of a cloud is the number of its group."""
    counts = [len(cloud.positions) for cloud in clouds]
    degree = max((cloud.degree for cloud in clouds), default=0)
    shaded = any(cloud.shading is not None for cloud in clouds)
    texels = np.zeros((sum(counts), TEXELS + SHADED * shaded + HARMONICS[degree], 4), np.float32)
    starts = (0, *(int(stop) for stop in np.cumsum(counts)))
    for group, cloud in enumerate(clouds):
        part = texels[starts[group] : starts[group + 1]]
        part[:, 0, :3], part[:, 0, 3] = cloud.positions, group
        part[:, 1], part[:, 2, :2] = cloud.covariances[:, :4], cloud.covariances[:, 4:]
        part[:, 3] = cloud.base
        if shaded:
            part[:, TEXELS] = (0, 0, 0, 1) if cloud.shading is None else cloud.shading
        flat = cloud.harmonics.reshape(len(part), -1)
        part[:, TEXELS + SHADED * shaded :].reshape(len(part), -1)[:, : flat.shape[1]] = flat
    positions = [np.empty((0, 3), np.float32), *(cloud.positions for cloud in clouds)]
    return Table(texels, np.ascontiguousarray(np.concatenate(positions)), starts, degree, shaded)

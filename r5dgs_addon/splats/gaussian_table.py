"""Attributes of point clouds, packed for the splat shader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core.color import srgb
from ...r5dgs_core.scene import spherical_harmonics
from ..scene import point_clouds

GEOMETRY = 3  # texels of each Gaussian that change if it moves: position and group; rotation; standard deviations
SHADED = 1  # texels after color and opacity if any cloud has shading: vector and rest factor
TURNED = 1  # texels after those if any cloud bends: rotation of the bind state, wxyz; zero for clouds that do not bend
BALL = 0.3  # size of points without `scale`, as a fraction of their mean distance on a surface
LARGEST = 1e15  # standard deviation; covariances of larger ones overflow in the shader
# Further texels of the coefficients by degree, three channels each, without gaps.
HARMONICS = {degree: -(-3 * ((degree + 1) ** 2 - 1) // 4) for degree in range(4)}


@dataclass(frozen=True)
class Geometry:
    """Places and shapes of the Gaussians of a point cloud, in its own frame.

    Attributes:
        positions: Centres. [n, 3] float32
        quats: Rotations, wxyz of any length; zero for Gaussians that are not drawn. [n, 4] float32
        scales: Standard deviations. [n, 3] float32
    """

    positions: np.ndarray
    quats: np.ndarray
    scales: np.ndarray


@dataclass(frozen=True)
class Look:
    """Colors of the Gaussians of a point cloud. Equal ``source`` means equal values.

    Attributes:
        base: Degree-0 coefficients and opacity. [n, 4] float32
        harmonics: Coefficients of degree 1 and higher. [n, K - 1, 3] float32
        shading: Shading vector and rest factor, or None. [n, 4] float32
        bind: Rotations before residual motion, wxyz; harmonics and shading turn with it. None if unused. [n, 4] float32
        source: Fingerprints of the attributes that they were read from.
    """

    base: np.ndarray
    harmonics: np.ndarray
    shading: np.ndarray | None
    bind: np.ndarray | None
    source: tuple

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return spherical_harmonics.degree_of(self.harmonics.shape[1] + 1)


@dataclass(frozen=True)
class CloudData:
    """Gaussians of a point cloud."""

    geometry: Geometry
    look: Look


def read(cloud: bpy.types.PointCloud, color: Sequence[float], known: CloudData | None = None) -> CloudData:
    """Read an evaluated point cloud.

    Points without size become small balls, and points without radiance get `display_color` or else the given color, so
    that the output of any node is visible. Gaussians with values that are not finite are not drawn.

    Args:
        cloud: Evaluated point cloud.
        color: Linear color and opacity of points without any.
        known: Earlier result, whose look is kept if its attributes are unchanged, as while an object bends.
    """
    source = _look_source(cloud, color)
    look = known.look if known is not None and known.look.source == source else _look(cloud, color, source)
    return CloudData(_geometry(cloud), look)


def _geometry(cloud: bpy.types.PointCloud) -> Geometry:
    positions = _values(cloud, "position", "FLOAT_VECTOR", "vector", 3)
    if positions is None:
        positions = np.zeros((0, 3), np.float32)
    count = len(positions)
    scales = _values(cloud, "scale", "FLOAT_VECTOR", "vector", 3)
    quats = _values(cloud, "rotation", "QUATERNION", "value", 4)
    if scales is None:
        scales = np.full((count, 3), _ball(positions), np.float32)
    if quats is None:
        quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    odd = ~(np.abs(np.einsum("ij,ij->i", quats, quats) - 1) < 0.5) & np.isfinite(quats).all(1)
    if odd.any():
        lengths = np.linalg.norm(quats[odd].astype(np.float64), axis=1, keepdims=True)
        quats[odd] = np.where(lengths > 0, quats[odd] / np.maximum(lengths, 1e-300), (1, 0, 0, 0))
    ends = [end for values in (positions, quats, scales) if count for end in (-values.min(), values.max())]
    if not all(end < LARGEST for end in ends):
        good = np.isfinite(np.concatenate([positions, quats, scales], 1)).all(1) & (np.abs(scales) < LARGEST).all(1)
        for values in (positions, quats, scales):
            values[~good] = 0
    return Geometry(positions, quats, scales)


def _look_source(cloud: bpy.types.PointCloud, color: Sequence[float]) -> tuple:
    """Fingerprints of the attributes that the look is read from."""
    kinds = [("radiance:base", "FLOAT_COLOR", "color", 4), (point_clouds.DISPLAY_COLOR, "FLOAT_COLOR", "color", 4)]
    kinds += [(f"{point_clouds.HARMONICS}{k}", "FLOAT_VECTOR", "vector", 3) for k in range(15)]
    kinds += [(point_clouds.SHADING, "FLOAT_VECTOR", "vector", 3), (point_clouds.SHADING_REST, "FLOAT", "value", 1)]
    kinds += [(point_clouds.BIND + "rotation", "QUATERNION", "value", 4)]
    found: list = [len(cloud.points), tuple(color)]
    for name, kind, field, width in kinds:
        attribute = point_clouds.attribute(cloud, name, kind)
        values = None if attribute is None else point_clouds.view(attribute, field, width)
        found.append(None if values is None else point_clouds.fingerprint(values))
    return tuple(found)


def _look(cloud: bpy.types.PointCloud, color: Sequence[float], source: tuple) -> Look:
    count = len(cloud.points)
    base = _values(cloud, "radiance:base", "FLOAT_COLOR", "color", 4)
    if base is None:
        shown = _values(cloud, point_clouds.DISPLAY_COLOR, "FLOAT_COLOR", "color", 4)
        base = np.tile(np.float32(color), (count, 1)) if shown is None else shown
        base[:, :3] = (srgb.from_linear(base[:, :3].astype(np.float64)) - 0.5) / spherical_harmonics.C0
    base[~np.isfinite(base).all(1)] = 0
    harmonics, shading = _harmonics(cloud), _shading(cloud)
    seen = harmonics.shape[1] or shading is not None
    bind = _values(cloud, point_clouds.BIND + "rotation", "QUATERNION", "value", 4) if seen else None
    return Look(base, harmonics, shading, None if bind is None else np.nan_to_num(bind), source)


def _values(cloud: bpy.types.PointCloud, name: str, kind: str, field: str, width: int) -> np.ndarray | None:
    """Values of an attribute, or None if it is missing. [n, width]"""
    found = point_clouds.attribute(cloud, name, kind)
    return None if found is None else point_clouds.read(found, field, width)


def _ball(positions: np.ndarray) -> float:
    """Standard deviation of points without size: a share of their spacing on a surface as large as the cloud."""
    places = positions[np.isfinite(positions).all(1)]
    size = float(np.linalg.norm(np.ptp(places.astype(np.float64), axis=0))) if len(places) > 1 else 0.0
    return BALL * size / np.sqrt(len(places)) if size else 1.0


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
        geometry: `GEOMETRY` texels of each Gaussian. [N, 3, 4] float32
        looks: Color and opacity; shading and bind state if any cloud has it; harmonics. [N, texels, 4] float32
        positions: Centres. [N, 3] float32
        starts: First Gaussian of each group, and N. [G + 1]
        degree: Highest degree of the groups.
        shaded: True if any group has shading.
        turned: True if any group has a bind state.
    """

    geometry: np.ndarray
    looks: np.ndarray
    positions: np.ndarray
    starts: tuple[int, ...]
    degree: int
    shaded: bool
    turned: bool

    def move(self, group: int, geometry: Geometry) -> None:
        """Change the geometry of a group in place; the number of Gaussians stays the same."""
        rows = slice(self.starts[group], self.starts[group + 1])
        part = self.geometry[rows]
        part[:, 0, :3], part[:, 0, 3] = geometry.positions, group
        part[:, 1], part[:, 2, :3] = geometry.quats, geometry.scales
        self.positions[rows] = geometry.positions


def pack(clouds: Sequence[CloudData]) -> Table:
    """Concatenate clouds; the index of a cloud is the number of its group."""
    counts = [len(cloud.geometry.positions) for cloud in clouds]
    degree = max((cloud.look.degree for cloud in clouds), default=0)
    shaded = any(cloud.look.shading is not None for cloud in clouds)
    turned = any(cloud.look.bind is not None for cloud in clouds)
    rest = 1 + SHADED * shaded + TURNED * turned
    total, starts = sum(counts), (0, *(int(stop) for stop in np.cumsum(counts)))
    looks = np.zeros((total, rest + HARMONICS[degree], 4), np.float32)
    geometry, positions = np.zeros((total, GEOMETRY, 4), np.float32), np.zeros((total, 3), np.float32)
    table = Table(geometry, looks, positions, starts, degree, shaded, turned)
    for group, cloud in enumerate(clouds):
        table.move(group, cloud.geometry)
        look = cloud.look
        part = looks[starts[group] : starts[group + 1]]
        part[:, 0] = look.base
        if shaded:
            part[:, 1] = (0, 0, 0, 1) if look.shading is None else look.shading
        if look.bind is not None:
            part[:, rest - TURNED] = look.bind
        flat = look.harmonics.reshape(len(part), -1)
        part[:, rest:].reshape(len(part), -1)[:, : flat.shape[1]] = flat
    return table

"""Copies of point clouds that keep some of their points."""

import bpy
import numpy as np

from .. import compat
from . import point_clouds

_FIELDS: dict[str, tuple[str, int, type]] = {  # name, width and dtype of the values, by type of attribute
    "FLOAT": ("value", 1, np.float32),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT2": ("vector", 2, np.float32),
    "FLOAT_COLOR": ("color", 4, np.float32),
    "BYTE_COLOR": ("color", 4, np.float32),
    "QUATERNION": ("value", 4, np.float32),
    "INT": ("value", 1, np.int32),
    "INT8": ("value", 1, np.int32),
    "INT32_2D": ("value", 2, np.int32),
    "BOOLEAN": ("value", 1, bool),
}


def of(cloud: bpy.types.PointCloud, keep: np.ndarray) -> bpy.types.PointCloud:
    """Copy some points of a point cloud with all their attributes.

    Unedited attributes are unedited in the copy, too, so that their values are still taken from the scene file.

    Args:
        cloud: Point cloud.
        keep: Mask of the points, at least one. [n]

    Returns:
        New point cloud.
    """
    (copy,) = compat.new_point_clouds([int(keep.sum())])
    copy.name = cloud.name
    same: dict[str, tuple[str, str]] = {}  # fingerprints before and after, by attribute
    for source in cloud.attributes:
        if source.domain != "POINT" or source.data_type not in _FIELDS:
            continue
        name, (field, width, dtype) = source.name, _FIELDS[source.data_type]
        values = point_clouds.read(source, field, width, dtype)
        kept = np.ascontiguousarray(values[keep])
        target = copy.attributes.get(name) or copy.attributes.new(name, source.data_type, "POINT")
        target.data.foreach_set(field, kept.ravel())
        same[name] = point_clouds.fingerprint(values), point_clouds.fingerprint(kept)
    for material in cloud.materials:
        copy.materials.append(material)
    for key, value in cloud.items():
        copy[key] = value.to_dict() if hasattr(value, "to_dict") else value
    stored = point_clouds.fingerprints(cloud)
    for name in stored.keys() - {point_clouds.ROW}:  # the rows differ from those that were loaded
        before, after = same.get(point_clouds.BIND + name) or same.get(name, ("", ""))
        if before == stored[name]:
            copy[point_clouds.FINGERPRINTS][name] = after
    written = cloud.get(point_clouds.WRITTEN)
    for name, digest in () if written is None else written.items():
        if name in same and same[name][0] == digest:
            copy[point_clouds.WRITTEN][name] = same[name][1]
    compat.make_gaussian_splat(copy)
    copy.update_tag()
    return copy

"""Evaluated points of point clouds: after edits of their data and after modifiers.

A point cloud stores fingerprints of the attributes that were loaded. Attributes with unchanged fingerprints are taken
from the scene file; only the others are passed on. A point cloud is compared again after an update of its geometry,
after loading, undo and redo, and when a render starts; with modifiers, also at each rendered frame.
"""

import hashlib
from dataclasses import dataclass, field

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ...r5dgs_core import errors
from ...r5dgs_core.editing.point_edits import PointEdit
from ..ui import plural
from . import point_clouds, viewport_display

PARTS = {
    "means": ("position", "FLOAT_VECTOR", "vector", 3),
    "quats": ("rotation", "QUATERNION", "value", 4),
    "scales": ("scale", "FLOAT_VECTOR", "vector", 3),
    "base": ("radiance:base", "FLOAT_COLOR", "color", 4),
}
BENDING = ("means", "quats", "scales")  # attributes that Exact Mode overwrites at every frame


@dataclass(frozen=True)
class Edit:
    """Edited points of a point cloud, compared by ``key``.

    Attributes:
        key: Digest of the points.
        points: The attributes that differ from the scene file.
        bent: True if Exact Mode has already applied the residual motion.
    """

    key: str
    points: PointEdit = field(compare=False)
    bent: bool = field(default=False, compare=False)

    def arrays(self) -> dict[str, np.ndarray]:
        """Contiguous arrays that differ from the scene file, and ``rows``, for the worker."""
        names = ("rows", *PARTS, "sh")
        found = {name: getattr(self.points, name) for name in names}
        return {name: np.ascontiguousarray(values) for name, values in found.items() if values is not None}


@dataclass(frozen=True)
class Comparison:
    """Result of comparing a point cloud with the scene file.

    Attributes:
        edit: Edited points, or None if there is no difference.
        notes: Messages about points that cannot be drawn; each begins with the object's name.
    """

    edit: Edit | None = None
    notes: tuple[str, ...] = ()


_known: dict[tuple, tuple[int, Comparison]] = {}  # by object and depsgraph; with session_uid of the data


def of(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, gaussians: int) -> Comparison:
    """Compare a point cloud's evaluated points with its scene file.

    Args:
        obj: Original point cloud object.
        depsgraph: Evaluated depsgraph.
        gaussians: Number of Gaussians in the scene file.

    Returns:
        The difference.

    Raises:
        ConfigError: Points were deleted or added, and the attribute `gaussian` is missing.
    """
    edited = _is_modified(obj, depsgraph)
    key = (obj.session_uid, depsgraph.mode, depsgraph.scene.session_uid, depsgraph.view_layer.name)
    known = _known.get(key)
    if known is not None and known[0] == obj.data.session_uid and not (edited and depsgraph.mode == "RENDER"):
        return known[1]
    found = _compare(obj, depsgraph, edited, gaussians)
    _known[key] = obj.data.session_uid, found
    return found


def notes(collection: bpy.types.Collection) -> list[str]:
    """Return the cached notes about a loaded scene's point clouds, without a new comparison."""
    known = [
        (key[0], found) for key, (_, found) in list(_known.items()) if found.notes
    ]  # a render thread may add entries
    own = {obj.session_uid for obj in collection.all_objects} if known else set()
    return list(dict.fromkeys(note for uid, found in known if uid in own for note in found.notes))


def forget(*_) -> None:
    """Clear the cache, so that all point clouds are compared again."""
    _known.clear()


def evaluated(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bpy.types.PointCloud:
    """Return a point cloud after its modifiers, or before them if older ellipsoids hide its points."""
    found = obj.evaluated_get(depsgraph).data
    return obj.data if len(found.points) == 0 and viewport_display.hides_points(obj) else found


def _is_modified(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if enabled modifiers other than those of the display change the points."""
    flag = "show_render" if depsgraph.mode == "RENDER" else "show_viewport"
    found = obj.evaluated_get(depsgraph).modifiers  # renders do not write animated switches to the original
    return any(one.name not in viewport_display.MODIFIERS and getattr(one, flag) for one in found)


def _compare(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, edited: bool, gaussians: int) -> Comparison:
    cloud, problems = evaluated(obj, depsgraph), []
    hidden = cloud == obj.data
    if hidden and edited:
        problems.append("ellipsoids of an earlier version hide its modifiers from R5DGS; choose the display again")
    stored = point_clouds.fingerprints(obj.data)
    bound = point_clouds.attribute(cloud, point_clouds.BIND + "position", "FLOAT_VECTOR") is not None
    bent = bound and edited and not hidden
    prefix = point_clouds.BIND if bound and not bent else ""
    rows = _rows(obj, cloud, stored)
    values: dict[str, np.ndarray] = {}
    for part, (name, *kind) in PARTS.items():
        if prefix and part in BENDING:  # Exact Mode applies edits without a new evaluation
            found = _changed(obj.data, prefix + name, stored.get(name), *kind)
        else:
            found = _changed(cloud, name, stored.get(name), *kind)
        if found is not None:
            values[part] = found
    sh = _changed_harmonics(cloud, stored)
    if sh is not None:
        values["sh"] = sh
    missing = [name for name, kind, *_ in PARTS.values() if point_clouds.attribute(cloud, name, kind) is None]
    if missing and len(cloud.points):
        problems.append(f"{', '.join(missing)} missing or of another type; the scene file's values are drawn")
    if edited and not hidden:
        problems += _made_besides_points(obj, depsgraph)
    if _is_radius_changed(obj, cloud, stored):
        problems.append("the radius of points is for display only; change the attribute 'scale' instead")
    if rows is None and not values:
        return Comparison(None, _notes(obj, problems))
    whole = np.arange(obj.r5dgs.start, obj.r5dgs.start + obj.r5dgs.count, dtype=np.int32)
    rows = whole if rows is None else rows
    there = _drawable(rows, values, gaussians)
    if not there.all():
        problems.append(f"{plural.of(int((~there).sum()), 'point')} without a Gaussian; new points are not drawn")
        rows, values = rows[there], {part: found[there] for part, found in values.items()}
    values = _without_the_originals(obj, rows, values, stored)
    edit = None
    if values or not np.array_equal(rows, whole):
        edit = Edit(_key(rows, values), PointEdit(rows, **values), bent)
    return Comparison(edit, _notes(obj, problems))


def _notes(obj: bpy.types.Object, problems: list[str]) -> tuple[str, ...]:
    return tuple(f"{obj.name}: {text}" for text in problems)


def _rows(obj: bpy.types.Object, cloud: bpy.types.PointCloud, stored: dict[str, str]) -> np.ndarray | None:
    """Scene file row of each point, or None if they are unchanged. [n] int32"""
    attribute = point_clouds.attribute(cloud, point_clouds.ROW, "INT")
    if attribute is None:
        if len(cloud.points) == obj.r5dgs.count:
            return None
        if len(cloud.points) == 0:
            return np.zeros(0, np.int32)
        raise errors.ConfigError(
            f"{obj.name}: expected its {obj.r5dgs.count} points, found {len(cloud.points)}, without the "
            f"attribute '{point_clouds.ROW}' that names the Gaussian of each; undo that change, or load the scene again"
        )
    rows = point_clouds.view(attribute, "value", 1, np.int32)[:, 0]
    if stored.get(point_clouds.ROW) == point_clouds.fingerprint(rows):
        return None
    start, count = obj.r5dgs.start, obj.r5dgs.count
    return None if len(rows) == count and (rows == np.arange(start, start + count)).all() else rows.copy()


def _changed(
    cloud: bpy.types.PointCloud, name: str, stored: str | None, kind: str, field_name: str, width: int
) -> np.ndarray | None:
    """Values of an attribute, or None if its fingerprint is unchanged or it cannot be read. [n, width]"""
    attribute = point_clouds.attribute(cloud, name, kind)
    if attribute is None:
        return None
    values = point_clouds.view(attribute, field_name, width)
    return None if stored is not None and point_clouds.fingerprint(values) == stored else values.copy()


def _changed_harmonics(cloud: bpy.types.PointCloud, stored: dict[str, str]) -> np.ndarray | None:
    """Higher-degree harmonics, or None if all fingerprints are unchanged or some are missing. [n, K, 3]"""
    count = sum(name.startswith(point_clouds.HARMONICS) for name in stored)
    kind = ("FLOAT_VECTOR", "vector", 3)
    names = [f"{point_clouds.HARMONICS}{k}" for k in range(count)]
    if all(_changed(cloud, name, stored[name], *kind) is None for name in names):
        return None
    found = [_changed(cloud, name, None, *kind) for name in names]
    return None if any(one is None for one in found) else np.stack(found, axis=1)


def _drawable(rows: np.ndarray, values: dict[str, np.ndarray], gaussians: int) -> np.ndarray:
    """Mask of drawable points; points added by nodes have no valid row or no size. [n] bool"""
    there = (rows >= 0) & (rows < gaussians)
    if "scales" in values:
        there &= values["scales"].any(-1)
    for found in values.values():
        there &= np.isfinite(found).all(axis=tuple(range(1, found.ndim)))
    return there


def _without_the_originals(
    obj: bpy.types.Object, rows: np.ndarray, values: dict[str, np.ndarray], stored: dict[str, str]
) -> dict[str, np.ndarray]:
    """Remove values that differ only because modifiers deleted, repeated or sorted points."""
    start = obj.r5dgs.start
    if not len(rows) or rows.min() < start or rows.max() >= start + obj.r5dgs.count:
        return values
    result = {}
    for part, found in values.items():
        kinds = {name: kind for name, *kind in PARTS.values()}
        names = [PARTS[part][0]] if part in PARTS else [f"{point_clouds.HARMONICS}{k}" for k in range(found.shape[1])]
        columns = found.reshape(len(rows), len(names), found.shape[-1])
        for k, name in enumerate(names):
            kind = kinds.get(name, ["FLOAT_VECTOR", "vector", 3])
            attribute = point_clouds.attribute(obj.data, name, kind[0])
            own = None if attribute is None else point_clouds.view(attribute, *kind[1:])
            if own is None or point_clouds.fingerprint(own) != stored.get(name):
                break
            if not np.array_equal(own[rows - start], columns[:, k]):
                break
        else:
            continue
        result[part] = found
    return result


def _is_radius_changed(obj: bpy.types.Object, cloud: bpy.types.PointCloud, stored: dict[str, str]) -> bool:
    hidden = any(obj.modifiers.get(name) is not None for name in viewport_display.MODIFIERS)  # they set it to 0
    cloud = obj.data if hidden else cloud
    radius = point_clouds.attribute(cloud, "radius", "FLOAT")
    if radius is None or "radius" not in stored or len(cloud.points) != obj.r5dgs.count:
        return False
    return point_clouds.fingerprint(point_clouds.view(radius, "value", 1)) != stored["radius"]


def _made_besides_points(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Messages about geometry created by modifiers that the engine does not draw."""
    if obj.modifiers.get(viewport_display.MODIFIER) is not None:  # instances are its ellipsoids
        return []
    own, instanced = set(), False
    for one in depsgraph.object_instances:
        if one.is_instance and one.parent is not None and one.parent.original == obj:
            own |= {one.object.type} if one.object.original == obj else set()
            instanced |= one.object.original != obj
    said = ["instances of its points are not drawn; add a Realize Instances node"] if "POINTCLOUD" in own else []
    others = sorted(kind.lower() for kind in own - {"POINTCLOUD"}) + ["instances"] * instanced
    return said + ([f"{', '.join(others)} made by its modifiers: not drawn"] if others else [])


def _key(rows: np.ndarray, values: dict[str, np.ndarray]) -> str:
    digest = hashlib.blake2b(point_clouds.fingerprint(rows).encode(), digest_size=16)
    for part, found in sorted(values.items()):
        digest.update(f"{part} {found.shape} {point_clouds.fingerprint(found)}".encode())
    return digest.hexdigest()


@persistent
def _follow_updates(_, depsgraph=None):
    """Remove the point clouds whose geometry was updated from the cache."""
    if not _known or depsgraph is None:
        return
    updated = {one.id.original.session_uid for one in depsgraph.updates if one.is_updated_geometry}
    for key, (data, _) in list(_known.items()):  # a render thread may change it meanwhile
        if key[0] in updated or data in updated:
            _known.pop(key, None)


@persistent
def _forget_all(*_):
    forget()


def _hooks():
    handlers = bpy.app.handlers
    every = (handlers.load_post, handlers.undo_post, handlers.redo_post, handlers.render_init)
    following = (handlers.depsgraph_update_post, handlers.frame_change_post)
    return [*((events, _forget_all) for events in every), *((events, _follow_updates) for events in following)]


def register():
    """Register the handlers."""
    for events, handler in _hooks():
        events.append(handler)


def unregister():
    """Undo `register`."""
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
    forget()

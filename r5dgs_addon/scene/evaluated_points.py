"""Points of clouds as Blender evaluates them: after edits of their data and after modifiers.

A cloud stores fingerprints of the attributes that it was loaded with. Attributes that still have theirs are those of
the scene file; only the others are handed on. A cloud is compared again after an update of its geometry, after loading,
undo and redo, and when a render begins; one with modifiers also at each frame of a render.
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
BENDING = ("means", "quats", "scales")  # parts that Exact Mode overwrites at every frame


@dataclass(frozen=True)
class Edit:
    """Edited points of a cloud; equal if they hold the same.

    Attributes:
        key: Digest of the points.
        points: The points. Only what differs from the scene file is there.
        bent: True if they are already bent as Exact Mode bends them.
    """

    key: str
    points: PointEdit = field(compare=False)
    bent: bool = field(default=False, compare=False)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that differ from the scene file, and ``rows``, contiguous, as the worker reads them."""
        names = ("rows", *PARTS, "sh")
        found = {name: getattr(self.points, name) for name in names}
        return {name: np.ascontiguousarray(values) for name, values in found.items() if values is not None}


@dataclass(frozen=True)
class Found:
    """Result of comparing a cloud's points with the scene file.

    Attributes:
        edit: The points, if they differ; else None.
        notes: Sentences on what cannot be drawn of them; each begins with the cloud's name.
    """

    edit: Edit | None = None
    notes: tuple[str, ...] = ()


_known: dict[tuple, tuple[int, Found]] = {}  # by object and depsgraph; with the session_uid of the object's data


def of(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, gaussians: int) -> Found:
    """Compare a cloud's evaluated points with its scene file.

    Args:
        obj: The cloud, original.
        depsgraph: Evaluated.
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
    """Return the notes of the last comparisons of a loaded scene's clouds, without comparing them again."""
    known = [(key[0], found) for key, (_, found) in list(_known.items()) if found.notes]  # renders add to it meanwhile
    own = {obj.session_uid for obj in collection.all_objects} if known else set()
    return list(dict.fromkeys(note for uid, found in known if uid in own for note in found.notes))


def forget(*_) -> None:
    """Compare all clouds again when they are needed next."""
    _known.clear()


def evaluated(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bpy.types.PointCloud:
    """Return a cloud's points after its modifiers; those before them if its ellipsoids hide them."""
    found = obj.evaluated_get(depsgraph).data
    return obj.data if len(found.points) == 0 and viewport_display.hides_points(obj) else found


def _is_modified(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if modifiers are on that change a cloud's points; ellipsoids do not."""
    flag = "show_render" if depsgraph.mode == "RENDER" else "show_viewport"
    found = obj.evaluated_get(depsgraph).modifiers  # a render does not write animated switches to the original
    return any(one.name != viewport_display.MODIFIER and getattr(one, flag) for one in found)


def _compare(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, edited: bool, gaussians: int) -> Found:
    cloud, problems = evaluated(obj, depsgraph), []
    hidden = cloud == obj.data
    if hidden and edited:
        problems.append("its modifiers are ignored under ellipsoids of an earlier version; choose the display again")
    stored = point_clouds.fingerprints(obj.data)
    bound = point_clouds.attribute(cloud, point_clouds.BIND + "position", "FLOAT_VECTOR") is not None
    bent = bound and edited and not hidden
    prefix = point_clouds.BIND if bound and not bent else ""
    rows = _rows(obj, cloud, stored)
    values: dict[str, np.ndarray] = {}
    for part, (name, *kind) in PARTS.items():
        if prefix and part in BENDING:  # Exact Mode takes edits over without a new evaluation
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
        return Found(None, _notes(obj, problems))
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
    return Found(edit, _notes(obj, problems))


def _notes(obj: bpy.types.Object, problems: list[str]) -> tuple[str, ...]:
    return tuple(f"{obj.name}: {text}" for text in problems)


def _rows(obj: bpy.types.Object, cloud: bpy.types.PointCloud, stored: dict[str, str]) -> np.ndarray | None:
    """Row of the scene file that each point is; None for those that the cloud was loaded with. [n] int32"""
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
    """Values of an attribute, or None if they have the stored fingerprint or cannot be read. [n, width]"""
    attribute = point_clouds.attribute(cloud, name, kind)
    if attribute is None:
        return None
    values = point_clouds.view(attribute, field_name, width)
    return None if stored is not None and point_clouds.fingerprint(values) == stored else values.copy()


def _changed_harmonics(cloud: bpy.types.PointCloud, stored: dict[str, str]) -> np.ndarray | None:
    """Harmonics of higher degree, or None if all of them have their fingerprints or some are missing. [n, K, 3]"""
    count = sum(name.startswith(point_clouds.HARMONICS) for name in stored)
    kind = ("FLOAT_VECTOR", "vector", 3)
    names = [f"{point_clouds.HARMONICS}{k}" for k in range(count)]
    if all(_changed(cloud, name, stored[name], *kind) is None for name in names):
        return None
    found = [_changed(cloud, name, None, *kind) for name in names]
    return None if any(one is None for one in found) else np.stack(found, axis=1)


def _drawable(rows: np.ndarray, values: dict[str, np.ndarray], gaussians: int) -> np.ndarray:
    """Points that are Gaussians: those that nodes add have no valid row, or no size. [n] bool"""
    there = (rows >= 0) & (rows < gaussians)
    if "scales" in values:
        there &= values["scales"].any(-1)
    for found in values.values():
        there &= np.isfinite(found).all(axis=tuple(range(1, found.ndim)))
    return there


def _without_the_originals(
    obj: bpy.types.Object, rows: np.ndarray, values: dict[str, np.ndarray], stored: dict[str, str]
) -> dict[str, np.ndarray]:
    """Values without those that only follow from points being deleted, repeated or sorted by modifiers."""
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
    radius = point_clouds.attribute(cloud, "radius", "FLOAT")
    if radius is None or "radius" not in stored or len(cloud.points) != obj.r5dgs.count:
        return False
    ellipsoids = obj.modifiers.get(viewport_display.MODIFIER) is not None  # they hide the points by their radius
    return not ellipsoids and point_clouds.fingerprint(point_clouds.view(radius, "value", 1)) != stored["radius"]


def _made_besides_points(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> list[str]:
    """Sentences on geometry that the modifiers of a cloud make and the engine does not draw."""
    if obj.modifiers.get(viewport_display.MODIFIER) is not None:  # its ellipsoids are instances like any others
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
    """Forget the clouds whose geometry was updated."""
    if not _known or depsgraph is None:
        return
    updated = {one.id.original.session_uid for one in depsgraph.updates if one.is_updated_geometry}
    for key, (data, _) in list(_known.items()):  # a render's thread may change it meanwhile
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
    """Listen to changes of clouds."""
    for events, handler in _hooks():
        events.append(handler)


def unregister():
    """Undo `register`."""
    for events, handler in _hooks():
        if handler in events:
            events.remove(handler)
    forget()

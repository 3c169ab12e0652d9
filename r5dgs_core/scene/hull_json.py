"""Hulls of a scene in the JSON member of its file, and their checks."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import errors, findings
from . import cameras
from .array_shapes import fail
from .hull import Hull
from .json_row import Row
from .scene import Scene

MAX_VERTICES = 64


def to_json(scene: Scene) -> list[dict[str, Any]]:
    """Return the entries of ``hulls``; the vertices are rounded to float32."""
    return [
        {
            "object_id": hull.object_id,
            "motion_id": hull.motion_id,
            "vertices": np.asarray(hull.vertices, np.float32).astype(np.float64).tolist(),
            **({} if hull.error is None else {"error": float(np.float32(hull.error))}),
        }
        for hull in scene.hulls
    ]


def read(row: Row) -> Hull:
    """Read an entry of ``hulls``. Raises `SceneFileError` naming place and key."""
    vertices = row.get("vertices", list)
    if vertices is not findings.UNREAD:
        if not 4 <= len(vertices) <= MAX_VERTICES:
            wanted = f"4 to {MAX_VERTICES} points"
            raise errors.SceneFileError(f"{row.place}: vertices: expected {wanted}, found {len(vertices)}")
        vertices = row.numbers("vertices", (len(vertices), 3))
    error = row.optional("error", float)
    return Hull(row.get("object_id", int), row.get("motion_id", int), vertices, error)


def check(scene: Scene, place: str, guard: findings.Guard) -> None:
    """Raise `SceneFileError` naming a hull that is invalid."""
    hulls = () if scene.hulls is findings.UNREAD else scene.hulls
    with guard():
        pairs = [(hull.object_id, hull.motion_id) for hull in hulls if hull is not findings.UNREAD]
        if len(set(pairs)) != len(pairs):
            fail(place, "hulls", "one hull for each object and motion", pairs[:5])
    for number, hull in enumerate(hulls):
        with guard():
            if hull is findings.UNREAD:
                continue
            where, shape = f"hull {number}", np.shape(hull.vertices)
            if len(shape) != 2 or shape[1] != 3 or not 4 <= shape[0] <= MAX_VERTICES:
                fail(place, where, f"vertices of shape (4 to {MAX_VERTICES}, 3)", shape)
            if not (np.abs(hull.vertices) <= cameras.FARTHEST).all():
                fail(place, where, f"vertices up to {cameras.FARTHEST:g}", hull.vertices)
            if isinstance(hull.error, float) and not 0 <= hull.error <= cameras.FARTHEST:
                fail(place, where, f"an error from 0 to {cameras.FARTHEST:g}", hull.error)
            if hull.object_id not in {item.id for item in scene.objects if item.id > 0}:
                fail(place, where, "the id of an object", hull.object_id)
            if not 0 <= hull.motion_id < len(scene.groups) or scene.groups[hull.motion_id].role == "shadow":
                fail(place, where, "a motion group that is no shadow", hull.motion_id)

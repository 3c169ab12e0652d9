"""The JSON member of a scene file: everything of a `Scene` that is not an array of Gaussians or knots."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, errors, strict_json
from ..motion.models import MotionModel
from .cameras import Camera
from .meanings import POOLINGS, EncoderCard, Table, View
from .scene import NEAR_PLANE, MotionGroup, Scene, SceneObject


def dump(scene: Scene, head: dict[str, Any]) -> bytes:
    """The JSON member as UTF-8, with the entries of ``head`` first."""
    light = scene.light_direction
    tree = {
        **head,
        "generator": f"r5dgs {__version__}",
        "name": scene.name,
        "gaussians": len(scene.means),
        "t_max": float(scene.t_max),
        "frames_per_unit": float(scene.frames_per_unit),
        "world_convention": scene.world_convention,
        "near_plane": float(scene.near_plane),
        "harmonics_turn": bool(scene.harmonics_turn),
        "objects": [
            {
                "id": o.id,
                "name": o.name,
                "aliases": list(o.aliases),
                "caption": o.caption,
                "color": [float(c) for c in o.color],
                "start": o.start,
                "count": o.count,
            }
            for o in scene.objects
        ],
        "groups": [
            {
                "id": g.id,
                "object_id": g.object_id,
                "role": g.role,
                "anchor_index": g.anchor_index,
                "pivot": np.asarray(g.pivot, np.float64).tolist(),
                "model": g.model.to_dict(),
                "follows": g.follows,
                "follow_matrix": None if g.follow_matrix is None else np.asarray(g.follow_matrix, np.float64).tolist(),
                "rigid_rms": float(g.rigid_rms),
                "rigid_max": float(g.rigid_max),
                "seen": None if g.seen is None else [float(t) for t in g.seen],
            }
            for g in scene.groups
        ],
        "cameras": [
            {
                "name": c.name,
                "width": c.width,
                "height": c.height,
                "intrinsics": c.intrinsics.tolist(),
                "T_cam_world": c.T_cam_world.tolist(),
            }
            for c in scene.cameras
        ],
        "light_direction": None if light is None else np.asarray(light, np.float64).tolist(),
        "vocabulary": list(scene.vocabulary),
        **({} if scene.lookup is None else {"lookup": _table_tree(scene.lookup)}),
        "provenance": scene.provenance,
        "needs": list(scene.needs),
    }
    try:
        data = json.dumps(tree, indent=1, allow_nan=False, default=_plain, ensure_ascii=False).encode()
    except (ValueError, TypeError, RecursionError) as error:  # of what the caller put into provenance and needs
        raise errors.SceneFileError(f"scene.json: expected what JSON can hold: {error}") from error
    strict_json.parse(data, "scene.json", errors.SceneFileError, "change names, provenance or needs")
    return data


def fields(data: dict[str, Any], place: str) -> dict[str, Any]:
    """The fields of `Scene` that are not arrays of the zip. Raises `SceneFileError` naming place and key."""
    light = data.get("light_direction")
    return {
        "name": get(data, "name", str, place),
        "objects": tuple(each(data, "objects", _read_object, place)),
        "groups": tuple(each(data, "groups", _read_group, place)),
        "t_max": get(data, "t_max", float, place),
        "frames_per_unit": get(data, "frames_per_unit", float, place),
        "world_convention": get(data, "world_convention", str, place),
        "cameras": tuple(each(data, "cameras", _read_camera, place)),
        "light_direction": None if light is None else numbers(data, "light_direction", (3,), place),
        "vocabulary": tuple(words(data, "vocabulary", place)),
        "lookup": table(data, place),
        "provenance": get(data, "provenance", dict, place),
        "needs": tuple(each(data, "needs", lambda row, place: dict(row), place)),
        "near_plane": get(data, "near_plane", float, place) if "near_plane" in data else NEAR_PLANE,
        "harmonics_turn": get(data, "harmonics_turn", bool, place) if "harmonics_turn" in data else True,
    }


def table(data: dict[str, Any], place: str) -> Table | None:
    """What is said about the embeddings, None in files that say nothing. Raises as `fields` does."""
    if data.get("lookup") is None:
        return None
    found, place = get(data, "lookup", dict, place), f"{place}: lookup"
    encoder = get(found, "encoder", dict, place)
    card = EncoderCard(
        kind=get(encoder, "kind", str, place),
        name=get(encoder, "name", str, place),
        digest=get(encoder, "digest", str, place),
        dimension=get(encoder, "dimension", int, place),
        templates=tuple(words(encoder, "templates", place)),
        scale=get(encoder, "scale", float, place),
    )
    pooling = get(found, "pooling", str, place)
    if pooling not in POOLINGS:
        raise errors.SceneFileError(f"{place}: pooling: expected one of {POOLINGS}, found {pooling!r}")
    rows = each(found, "objects", lambda row, place: row, place)
    return Table(
        encoder=card,
        canonical=tuple(words(found, "canonical", place)),
        views=tuple(tuple(each(row, "views", _read_view, place)) for row in rows),
        thresholds=tuple(None if row.get("threshold") is None else get(row, "threshold", float, place) for row in rows),
        margin=get(found, "margin", float, place),
        pooling=pooling,
    )


def get(data: dict[str, Any], key: str, kind: type, place: str) -> Any:
    """The value of a key, of the wanted JSON type; whole numbers pass for float."""
    value = data.get(key)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        found = "nothing" if key not in data else repr(value)[:60]
        raise errors.SceneFileError(f"{place}: {key}: expected {kind.__name__}, found {found}")
    return value


def each(data: dict[str, Any], key: str, reader: Callable[[dict[str, Any], str], Any], place: str) -> list[Any]:
    """The objects of a list, each through ``reader``, which is also told the place."""
    rows = get(data, key, list, place)
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            raise errors.SceneFileError(f"{place}: {key}[{i}]: expected an object, found {row!r}")
    return [reader(row, f"{place}: {key}[{i}]") for i, row in enumerate(rows)]


def numbers(data: dict[str, Any], key: str, shape: tuple[int, ...], place: str) -> np.ndarray:
    """Finite numbers of a given shape, float64."""
    try:
        array = np.array(data.get(key), np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise errors.SceneFileError(
            f"{place}: {key}: expected finite numbers of shape {shape}, found {data.get(key)!r}"
        )
    return array


def words(data: dict[str, Any], key: str, place: str) -> list[str]:
    """A list of strings."""
    words = get(data, key, list, place)
    for word in words:
        if not isinstance(word, str):
            raise errors.SceneFileError(f"{place}: {key}: expected words, found {word!r}")
    return words


def _read_object(row: dict[str, Any], place: str) -> SceneObject:
    r, g, b = numbers(row, "color", (3,), place).tolist()
    return SceneObject(
        id=get(row, "id", int, place),
        name=get(row, "name", str, place),
        aliases=tuple(words(row, "aliases", place)),
        caption=get(row, "caption", str, place),
        color=(r, g, b),
        start=get(row, "start", int, place),
        count=get(row, "count", int, place),
    )


def _read_group(row: dict[str, Any], place: str) -> MotionGroup:
    try:
        model = MotionModel.from_dict(get(row, "model", dict, place))
    except ValueError as error:
        raise errors.SceneFileError(f"{place}: model: {error}") from error
    follows = row.get("follows")
    return MotionGroup(
        id=get(row, "id", int, place),
        object_id=get(row, "object_id", int, place),
        role=get(row, "role", str, place),
        anchor_index=get(row, "anchor_index", int, place),
        pivot=numbers(row, "pivot", (3,), place),
        model=model,
        follows=None if follows is None else get(row, "follows", int, place),
        follow_matrix=None if row.get("follow_matrix") is None else numbers(row, "follow_matrix", (3, 3), place),
        rigid_rms=get(row, "rigid_rms", float, place),
        rigid_max=get(row, "rigid_max", float, place),
        seen=None if row.get("seen") is None else _interval(numbers(row, "seen", (2,), place)),
    )


def _read_view(row: dict[str, Any], place: str) -> View:
    left, top, right, bottom = (0.0,) * 4 if row.get("box") is None else numbers(row, "box", (4,), place).tolist()
    return View(
        source=get(row, "source", str, place),
        threshold=get(row, "threshold", float, place),
        t=None if row.get("t") is None else get(row, "t", float, place),
        box=None if row.get("box") is None else (left, top, right, bottom),
    )


def _table_tree(found: Table) -> dict[str, Any]:
    """JSON form of what `table` reads."""
    card = found.encoder
    return {
        "encoder": {
            "kind": card.kind,
            "name": card.name,
            "digest": card.digest,
            "dimension": card.dimension,
            "templates": list(card.templates),
            "scale": float(card.scale),
        },
        "canonical": list(found.canonical),
        "margin": float(found.margin),
        "pooling": found.pooling,
        "objects": [
            {"threshold": None if threshold is None else float(threshold), "views": [_view_tree(v) for v in views]}
            for threshold, views in zip(found.thresholds, found.views, strict=True)
        ],
    }


def _view_tree(view: View) -> dict[str, Any]:
    place = {} if view.box is None else {"box": [float(edge) for edge in view.box]}
    when = {} if view.t is None else {"t": float(view.t)}
    return {"source": view.source, "threshold": float(view.threshold), **when, **place}


def _interval(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _read_camera(row: dict[str, Any], place: str) -> Camera:
    return Camera(
        width=get(row, "width", int, place),
        height=get(row, "height", int, place),
        intrinsics=numbers(row, "intrinsics", (3, 3), place),
        T_cam_world=numbers(row, "T_cam_world", (4, 4), place),
        name=get(row, "name", str, place),
    )


def _plain(value: Any) -> Any:
    """JSON form of what provenance may hold besides JSON types."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise errors.SceneFileError(f"provenance or needs: expected JSON types, found {type(value).__name__}")

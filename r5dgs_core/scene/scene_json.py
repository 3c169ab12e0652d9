"""The JSON member of a scene file: all fields of `Scene` except the arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, errors, findings, strict_json
from ..motion.joint import Joint
from ..motion.models import MotionModel
from . import history_json, joint_json, presence, units
from .cameras import Camera
from .json_row import Row
from .lookup_table import POOLINGS, EmbeddingSource, EncoderCard, LookupTable
from .scene import NEAR_PLANE, MotionGroup, Scene, SceneObject


def dump(scene: Scene, head: dict[str, Any]) -> bytes:
    """JSON member as UTF-8, with the entries of ``head`` first."""
    light = None if scene.shading is None else scene.shading.light
    tree = {
        **head,
        "generator": f"r5dgs {__version__}",
        "name": scene.name,
        "gaussians": len(scene.gaussians.means),
        "t_max": float(scene.t_max),
        "frames_per_unit": float(scene.frames_per_unit),
        "world_convention": scene.world_convention,
        **scene.units.to_json(),
        "near_plane": float(scene.near_plane),
        "harmonics_turn": bool(scene.harmonics_turn),
        "objects": [_object_tree(item) for item in scene.objects],
        "groups": [_group_tree(group) for group in scene.groups],
        "cameras": [_camera_tree(camera) for camera in scene.cameras],
        "light_direction": None if light is None else np.asarray(light, np.float64).tolist(),
        "vocabulary": list(scene.vocabulary),
        **({} if scene.lookup is None else {"lookup": _table_tree(scene.lookup)}),
        "provenance": scene.provenance,
        "needs": list(scene.needs),
    }
    try:
        data = json.dumps(tree, indent=1, allow_nan=False, default=_plain, ensure_ascii=False).encode()
    except (ValueError, TypeError, RecursionError) as error:  # caused by the caller's provenance or needs
        raise errors.SceneFileError(f"scene.json: expected JSON types and finite numbers: {error}") from error
    strict_json.parse(data, "scene.json", errors.SceneFileError, "change names, provenance or needs")
    return data


def fields(top: Row) -> dict[str, Any]:
    """Fields of `Scene` that are not arrays of the zip. Raises `SceneFileError` naming place and key."""
    return {
        "name": top.get("name", str),
        "objects": top.each("objects", _read_object),
        "groups": top.each("groups", _read_group),
        "t_max": top.get("t_max", float),
        "frames_per_unit": top.get("frames_per_unit", float),
        "world_convention": top.get("world_convention", str),
        "units": findings.attempt(top.guard, lambda: _units(top)),
        "cameras": top.each("cameras", _read_camera),
        "light_direction": None if top.lacks("light_direction") else top.numbers("light_direction", (3,)),
        "vocabulary": top.words("vocabulary"),
        "lookup": table(top),
        "provenance": top.get("provenance", dict),
        "needs": top.each("needs", lambda row: dict(row.data)),
        "near_plane": top.get("near_plane", float) if top.has("near_plane") else NEAR_PLANE,
        "harmonics_turn": top.get("harmonics_turn", bool) if top.has("harmonics_turn") else True,
    }


def table(top: Row) -> LookupTable | None:
    """Metadata of the embeddings; None in files without it. Raises as `fields` does."""
    if top.lacks("lookup"):
        return None
    found = Row(top.get("lookup", dict), f"{top.place}: lookup", top.guard)
    if found.data is findings.UNREAD:
        return findings.UNREAD
    encoder = Row(found.get("encoder", dict), found.place, found.guard)
    return LookupTable(
        encoder=EncoderCard(
            kind=encoder.get("kind", str),
            name=encoder.get("name", str),
            digest=encoder.get("digest", str),
            dimension=encoder.get("dimension", int),
            templates=encoder.words("templates"),
            scale=encoder.get("scale", float),
        ),
        pooling=findings.attempt(top.guard, lambda: _pooling(found)),
        canonical=found.words("canonical"),
        views=found.each("objects", lambda row: row.each("views", _read_view)),
        thresholds=found.each("objects", lambda row: row.optional("threshold", float)),
        margin=found.get("margin", float),
    )


def _units(top: Row) -> units.Units:
    try:
        return units.read(top.data)
    except ValueError as error:
        raise errors.SceneFileError(f"{top.place}: {error}") from error


def _pooling(found: Row) -> str:
    pooling = found.get("pooling", str)
    if pooling not in POOLINGS:
        raise errors.SceneFileError(f"{found.place}: pooling: expected one of {POOLINGS}, found {pooling!r}")
    return pooling


def _read_object(row: Row) -> SceneObject:
    return SceneObject(
        color=row.floats("color", 3),
        id=row.get("id", int),
        name=row.get("name", str),
        aliases=row.words("aliases"),
        caption=row.get("caption", str),
        start=row.get("start", int),
        count=row.get("count", int),
    )


def _read_group(row: Row) -> MotionGroup:
    smooth, model = None, findings.attempt(row.guard, lambda: _model(row, "model"))
    if not row.lacks("trajectory"):
        smooth, model = model, findings.attempt(row.guard, lambda: _model(row, "trajectory"))
    return MotionGroup(
        model=model,
        smooth=smooth,
        id=row.get("id", int),
        object_id=row.get("object_id", int),
        role=row.get("role", str),
        anchor_index=row.get("anchor_index", int),
        pivot=row.numbers("pivot", (3,)),
        follows=row.optional("follows", int),
        follow_matrix=None if row.lacks("follow_matrix") else row.numbers("follow_matrix", (3, 3)),
        rigid_rms=row.get("rigid_rms", float),
        rigid_max=row.get("rigid_max", float),
        seen=None if row.lacks("seen") else row.floats("seen", 2),
        history=findings.attempt(row.guard, lambda: history_json.read(row)),
        parent=row.optional("parent", int),
        joint=findings.attempt(row.guard, lambda: _read_joint(row)),
        absent=findings.attempt(row.guard, lambda: presence.read(row)),
    )


def _read_joint(row: Row) -> Joint | None:
    return (
        None if row.lacks("joint") else joint_json.read(Row(row.get("joint", dict), f"{row.place}: joint", row.guard))
    )


def _model(row: Row, key: str) -> MotionModel:
    tree = row.get(key, dict)
    if tree is findings.UNREAD:
        return findings.UNREAD
    try:
        return MotionModel.from_dict(tree)
    except ValueError as error:
        raise errors.SceneFileError(f"{row.place}: {key}: {error}") from error


def _read_camera(row: Row) -> Camera:
    entries = {
        "width": row.get("width", int),
        "height": row.get("height", int),
        "intrinsics": row.numbers("intrinsics", (3, 3)),
        "T_cam_world": row.numbers("T_cam_world", (4, 4)),
        "name": row.get("name", str),
    }
    return findings.UNREAD if any(entry is findings.UNREAD for entry in entries.values()) else Camera(**entries)


def _read_view(row: Row) -> EmbeddingSource:
    return EmbeddingSource(
        box=None if row.lacks("box") else row.floats("box", 4),
        source=row.get("source", str),
        threshold=row.get("threshold", float),
        t=row.optional("t", float),
    )


def _object_tree(item: SceneObject) -> dict[str, Any]:
    return {
        "id": item.id,
        "name": item.name,
        "aliases": list(item.aliases),
        "caption": item.caption,
        "color": [float(channel) for channel in item.color],
        "start": item.start,
        "count": item.count,
    }


def _group_tree(group: MotionGroup) -> dict[str, Any]:
    matrix = group.follow_matrix
    return {
        "id": group.id,
        "object_id": group.object_id,
        "role": group.role,
        "anchor_index": group.anchor_index,
        "pivot": np.asarray(group.pivot, np.float64).tolist(),
        "model": (group.smooth or group.model).to_dict(),
        "follows": group.follows,
        "follow_matrix": None if matrix is None else np.asarray(matrix, np.float64).tolist(),
        "rigid_rms": float(group.rigid_rms),
        "rigid_max": float(group.rigid_max),
        "seen": None if group.seen is None else [float(t) for t in group.seen],
        **history_json.to_json(group.history),
        **({} if group.smooth is None else {"trajectory": group.model.to_dict()}),
        **({} if group.joint is None else {"parent": group.parent, "joint": joint_json.to_json(group.joint)}),
        **({"absent": presence.to_json(group.absent)} if group.absent else {}),
    }


def _camera_tree(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": camera.intrinsics.tolist(),
        "T_cam_world": camera.T_cam_world.tolist(),
    }


def _table_tree(found: LookupTable) -> dict[str, Any]:
    """JSON form of an embedding table; inverse of `table`."""
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


def _view_tree(view: EmbeddingSource) -> dict[str, Any]:
    place = {} if view.box is None else {"box": [float(edge) for edge in view.box]}
    when = {} if view.t is None else {"t": float(view.t)}
    return {"source": view.source, "threshold": float(view.threshold), **when, **place}


def _plain(value: Any) -> Any:
    """JSON form of numpy values and paths in provenance."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise errors.SceneFileError(f"provenance or needs: expected JSON types, found {type(value).__name__}")

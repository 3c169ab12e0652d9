"""Reader of `.glb` files of `glb`: scenes with rigid motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..motion import joint as joints
from ..motion import rotations
from ..playback import group_dynamics
from ..scene import format_features, scene_json, validation
from ..scene.json_row import Row
from ..scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Shading, Tracks
from ..scene.units import Units
from . import glb, glb_motion, glb_splats, gltf

_MODE = "rigid"


def read(path: str | Path) -> Scene:
    """Read and validate a scene. Raises `SceneFileError` naming the place and the expected content.

    Gaussians, cameras and observed motion come from meshes, nodes and animations; names, models and the rest from
    ``extras.r5dgs``.
    """
    content = gltf.read(path)
    top = _extras(content)
    fields = scene_json.fields(top)
    version = {"format_version": top.get("scene_version", int)}
    features = Row(top.data | version, top.place)
    format_features.check(features.data, top.place)
    fields |= format_features.fields(features)
    groups, times = fields["groups"], top.numbers("track_times", (len(top.get("track_times", list)),))
    if len(times) == 0 or [group.id for group in groups] != list(range(len(groups))):
        raise content.error("extras.r5dgs: expected observed times, and groups that are numbered from 0")
    gaussians, shading = _gaussians(content, groups)
    light = fields.pop("light_direction")
    scene = Scene(
        **fields
        | {
            "gaussians": gaussians,
            "objects": _objects(fields["objects"], gaussians.object_ids),
            "tracks": Tracks(times, _tracks(content, groups, times, fields["units"])),
            "background_sh": np.asarray(_sky(top), np.float32),
            "shading": None if shading is None or light is None else _shading(shading, light),
            "provenance": {
                "imported": {"layout": glb.FORMAT_NAME, "file": str(path)},
                "versions": {"r5dgs": __version__},
            },
        }
    )
    scene = dataclasses.replace(scene, groups=tuple(_with_anchor(scene, group) for group in groups))
    validation.check(scene, content.place)
    return scene


def _extras(content: gltf.Content) -> Row:
    scenes = content.items("scenes")
    notes = scenes[0].get("extras") if scenes else None
    found = notes.get("r5dgs") if isinstance(notes, dict) else None
    if not isinstance(found, dict) or found.get("format") != glb.FORMAT_NAME:
        raise content.error("expected a file of 'r5dgs export --to glb', found none of its extras")
    if found.get("format_version") != glb.FORMAT_VERSION:
        wanted = f"expected format_version {glb.FORMAT_VERSION}, found {found.get('format_version')!r:.60}"
        raise content.error(f"extras.r5dgs: {wanted}; update R5DGS")
    empty = {"vocabulary": [], "needs": [], "provenance": {}}
    return Row(found | empty, f"{content.place}: extras.r5dgs")


def _tagged(content: gltf.Content, key: str) -> list[tuple[int, dict[str, Any], dict[str, Any]]]:
    """Nodes with an entry in their extras: number, node, extras."""
    found = []
    for number, node in enumerate(content.items("nodes")):
        notes = node.get("extras")
        own = notes.get("r5dgs") if isinstance(notes, dict) else None
        if isinstance(own, dict) and isinstance(own.get(key), int):
            found.append((number, node, own))
    return found


def _gaussians(content: gltf.Content, groups: Sequence[MotionGroup]) -> tuple[Gaussians, np.ndarray | None]:
    """Gaussians in the order of a scene, and their shading vectors with factors at t_max. [N, 4] or None"""
    pieces = []
    for number, node, own in _tagged(content, "object"):
        group, user = own.get("group"), f"node {number}"
        if not isinstance(group, int) or not 0 <= group < len(groups):
            raise content.error(f"{user}: group: expected a number below {len(groups)}, found {group!r:.60}")
        splats, shading = glb_splats.read(content, content.item("meshes", node.get("mesh"), user), user)
        pieces.append(((own["object"], group), splats, shading))
    if not pieces:
        raise content.error("expected nodes with Gaussians, found none")
    pieces.sort(key=lambda piece: piece[0])
    if len({splats.sh.shape[1] for _, splats, _ in pieces}) > 1:
        raise content.error("expected one degree of harmonics in all meshes")
    means = [splats.means + groups[g].home for (_, g), splats, _ in pieces]
    labels = [np.tile(np.array(key, np.int64), (len(splats.means), 1)) for key, splats, _ in pieces]
    ids = np.concatenate(labels).clip(-1, np.iinfo(np.int32).max).astype(np.int32)
    joined = {
        name: np.concatenate([getattr(splats, name) for _, splats, _ in pieces])
        for name in ("quats", "log_scales", "opacity_logits", "sh")
    }
    vectors = None
    if any(shading is not None for _, _, shading in pieces):
        plain = np.array([0, 0, 0, 1], np.float32)
        vectors = np.concatenate([np.tile(plain, (len(s.means), 1)) if v is None else v for _, s, v in pieces])
    arrays = {"means": np.concatenate(means).astype(np.float32), "object_ids": ids[:, 0], "motion_ids": ids[:, 1]}
    return Gaussians(**joined | arrays), vectors


def _objects(table: Sequence[SceneObject], ids: np.ndarray) -> tuple[SceneObject, ...]:
    """Table with the ranges of the Gaussians that the file holds."""
    starts, stops = (np.searchsorted(ids, [item.id for item in table], side=side) for side in ("left", "right"))
    rows = zip(table, starts.tolist(), stops.tolist(), strict=True)
    return tuple(dataclasses.replace(item, start=start, count=stop - start) for item, start, stop in rows)


def _tracks(content: gltf.Content, groups: Sequence[MotionGroup], times: np.ndarray, units: Units) -> np.ndarray:
    """Poses of all groups at the observed times, in the world. [G, S, 7]"""
    found = [item for item in content.items("animations") if item.get("name") == _MODE]
    nodes = {own["group"]: number for number, _, own in _tagged(content, "group") if "object" not in own}
    parts = _parts(content, groups)
    still = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(groups), len(times), 1))
    since = glb_motion.seconds_per_unit(units) * (times - times[0])
    since = since.astype(np.float32).astype(np.float64)
    world = {group.id: (still[0, :, :4], still[0, :, 4:]) for group in groups}
    for group in groups:
        if found and group.id in nodes:
            place = glb_motion.home(groups, group)
            world[group.id] = glb_motion.poses(content, found[0], nodes[group.id], place, since)
    for part, joint in parts:  # relative to the parent so far
        assert part.parent is not None
        above = groups[part.parent]
        world[part.id] = joints.composed(world[above.id], above.pivot, world[part.id], joint.point, part.pivot)
    poses = np.stack([np.concatenate(world[group.id], axis=-1) for group in groups])
    quats = rotations.make_continuous(np.moveaxis(poses[..., :4], 1, 0)[::-1])[::-1]
    poses[..., :4] = np.moveaxis(quats, 0, 1)
    poses[:, -1] = still[0, 0]
    return poses


def _parts(content: gltf.Content, groups: Sequence[MotionGroup]) -> list[tuple[MotionGroup, joints.Joint]]:
    """Groups with a parent, parents first."""
    for group in groups:
        if group.parent is not None and not 0 <= group.parent < len(groups):
            wanted = f"expected a number below {len(groups)}"
            raise content.error(f"group {group.id}: parent: {wanted}, found {group.parent!r}")
    try:
        return group_dynamics.parts_of(groups)
    except ValueError as error:
        raise content.error(str(error)) from error


def _sky(top: Row) -> np.ndarray:
    return top.numbers("background_sh", (len(top.get("background_sh", list)), 3))


def _shading(columns: np.ndarray, light: np.ndarray) -> Shading:
    rest = columns[:, 3]
    return Shading(columns[:, :3].copy(), light, rest.copy() if (rest != 1).any() else None)


def _with_anchor(scene: Scene, group: MotionGroup) -> MotionGroup:
    """Group with a representative among the Gaussians that the file holds."""
    rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
    if len(rows) and not (0 <= group.anchor_index < len(scene.gaussians.means) and group.anchor_index in rows):
        return dataclasses.replace(group, anchor_index=group_dynamics.representative(scene, rows))
    return group if len(rows) else dataclasses.replace(group, anchor_index=-1)

"""Reader of `.glb` files of `glb`: scenes with rigid motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..motion import joint as joints
from ..motion import rotations
from ..playback import group_dynamics
from ..scene.scene import Gaussians, MotionGroup, Scene
from ..scene.units import Units
from . import glb, glb_motion, glb_splats, gltf, scene_notes

_MODE = "rigid"


def read(path: str | Path) -> Scene:
    """Read and validate a scene. Raises `SceneFileError` naming the place and the expected content.

    Gaussians, cameras and observed motion come from meshes, nodes and animations; names, models and the rest from
    ``extras.r5dgs``.
    """
    content = gltf.read(path)
    scenes = content.items("scenes")
    found = scenes[0].get("extras") if scenes else None
    notes = found.get("r5dgs") if isinstance(found, dict) else None
    return scene_notes.to_scene(
        scene_notes.row(notes, glb.KIND, f"{content.place}: extras.r5dgs"),
        glb.KIND,
        str(path),
        lambda groups: _gaussians(content, groups),
        lambda groups, times, units: _tracks(content, groups, times, units),
    )


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
        splats = dataclasses.replace(splats, means=splats.means + _place(content, node, user))
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


def _place(content: gltf.Content, node: dict[str, Any], user: str) -> np.ndarray:
    """Translation of a node. [3]"""
    found = node.get("translation", [0.0] * 3)
    if not isinstance(found, list) or len(found) != 3 or not all(type(value) in (int, float) for value in found):
        raise content.error(f"{user}: translation: expected three numbers, found {found!r:.60}")
    return np.array(found, np.float64)


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

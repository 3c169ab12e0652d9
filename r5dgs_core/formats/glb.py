"""Scenes as animated binary glTF (`.glb`) with KHR_gaussian_splatting (docs/reference/glb.md).

A root node turns the data set's world to glTF's y up. Below it, each motion group has one node at its anchor, with
keys of translation and rotation; parts hang on the node of their parent. The Gaussians of an object in a group are a
mesh of a child of the group's node, whose place decides when other programs draw it (`draw_order`). ``extras.r5dgs``
of the file's scene holds all other data for our own programs. The extras of a node hold the number of its group,
object or camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files
from ..motion import rotations
from ..playback import modes
from ..playback.scene_player import Player, available
from ..scene import cameras
from ..scene.scene import MotionGroup, Scene
from . import draw_order, glb_motion, glb_splats, gltf, registry, scene_nodes, scene_notes

KIND = scene_notes.Kind("r5dgs glb", 1, "r5dgs export --to glb")
ELSEWHERE = ", in other programs"  # end of sentences about losses that our own programs do not have
_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from Blender's z up


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write a scene with its motion. Implements `registry.Format.write`."""
    with registry.writing(path), atomic_files.replacing(path) as stream:
        content, arrays = build(scene, options)
        gltf.write(stream, content, arrays)
    yield path


def build(scene: Scene, options: registry.Options) -> tuple[dict[str, Any], gltf.Arrays]:
    """Content of a file, for `gltf.write`. Raises ConfigError if no Gaussian is selected."""
    arrays = gltf.Arrays()
    tree = _Nodes()
    groups, meshes = _add_groups(scene, options, tree, arrays)
    _add_cameras(scene, tree)
    end = scene_nodes.end(scene, options)
    played = _modes(scene)
    animations = [glb_motion.animation(scene, groups, meshes, end, arrays, *mode) for mode in played]
    up, size = _Y_UP @ cameras.WORLD_TO_BLENDER[scene.world_convention], scene.units.meters_per_unit
    scale = {} if size is None else {"scale": [size] * 3}
    root = tree.add(scene.name, None, rotation=_xyzw(up), **scale, children=tree.roots)
    extras = scene_notes.of(scene, end, KIND) | {"modes": [mode for mode, _ in played], "lost": losses(scene, options)}
    content = {
        "asset": {"version": "2.0", "generator": "r5dgs"},
        "extensionsUsed": [glb_splats.EXTENSION],
        "scene": 0,
        "scenes": [{"name": scene.name, "nodes": [root], "extras": {"r5dgs": extras}}],
        "nodes": tree.nodes,
        "meshes": tree.meshes,
        **({"cameras": tree.cameras} if tree.cameras else {}),
    }
    if any(found is not None for found in animations):
        content["animations"] = [found for found in animations if found is not None]
    return content, arrays


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that a file does not hold, or that only our own programs read, as sentences."""
    found = scene_nodes.lost_bending(scene, options.object_ids)
    lost = [mode for mode in modes.MODES if mode != "rigid" and available(scene, mode)]
    if lost:
        found.append(f"motion of single Gaussians (modes {', '.join(lost)})")
    if scene.gaussians.identities is not None:
        found.append("identity encodings and their classifier")
    if scene.embeddings is not None:
        found.append("embeddings; stored words keep the objects that they match")
    if scene.shading is not None:
        found.append(f"colours other than those of t_max{ELSEWHERE}")
    if len(scene.background_sh) > 1 or scene.background_sh.any():
        found.append(f"the sky{ELSEWHERE}")
    return found


def _modes(scene: Scene) -> list[tuple[str, str]]:
    """Playback modes in which groups move rigidly: name, and source of the motion past t_max."""
    found = [("rigid", "fitted")]
    if any(group.joint is not None for group in scene.groups):
        return found
    return found + [(f"rigid/{source}", source) for source in modes.SOURCES[1:] if available(scene, f"rigid/{source}")]


class _Nodes:
    """Nodes with unique names, meshes and cameras of a file in the making."""

    def __init__(self):
        self.nodes: list[dict[str, Any]] = []
        self.meshes: list[Any] = []
        self.cameras: list[dict[str, Any]] = []
        self.roots: list[int] = []
        self._names: set[str] = set()

    def add(self, name: str, parent: int | None, **fields: Any) -> int:
        """Add a node below another one and return its number."""
        unique, count = name, 1
        while unique in self._names:
            count += 1
            unique = f"{name} {count}"
        self._names.add(unique)
        self.nodes.append({"name": unique, **fields})
        number = len(self.nodes) - 1
        if parent is not None:
            self.nodes[parent].setdefault("children", []).append(number)
        return number


def _add_groups(
    scene: Scene, options: registry.Options, tree: _Nodes, arrays: gltf.Arrays
) -> tuple[dict[int, int], dict[int, int]]:
    """Add a node for each motion group with selected Gaussians, and for their parents.

    Returns:
        Their numbers by group, and the group of each node with Gaussians.
    """
    pieces = scene_nodes.pieces(scene, options.object_ids)
    numbers: dict[int, int] = {}
    meshes: dict[int, int] = {}
    names = {item.id: item.name for item in scene.objects}
    group_names = scene_nodes.group_names(scene)

    def node_of(group: MotionGroup) -> int:
        if group.id not in numbers:
            parent = None if group.parent is None else node_of(scene.groups[group.parent])
            extras = {"r5dgs": {"group": group.id, "role": group.role}}
            place = glb_motion.home(scene.groups, group).tolist()
            numbers[group.id] = tree.add(group_names[group.id], parent, translation=place, extras=extras)
            if parent is None:
                tree.roots.append(numbers[group.id])
        return numbers[group.id]

    factors = Player(scene).frame(scene.t_max).shading_factor
    for (rows, object_id, motion_id), origin in zip(pieces, draw_order.origins(scene, pieces), strict=True):
        group = scene.groups[motion_id]
        name = f"{names[object_id]} Gaussians" + ("" if motion_id == 0 else f" in group {motion_id}")
        tree.meshes.append(glb_splats.mesh(scene, rows, group.home + origin, factors, arrays, name))
        extras = {"r5dgs": {"group": motion_id, "object": object_id}}
        moved = {"translation": origin.tolist()} if origin.any() else {}
        meshes[tree.add(name, node_of(group), mesh=len(tree.meshes) - 1, extras=extras, **moved)] = motion_id
    return numbers, meshes


def _add_cameras(scene: Scene, tree: _Nodes) -> None:
    """Add the captured cameras. Lenses with an off-centre principal point are centred; extras have the exact ones."""
    for number, camera in enumerate(scene.cameras):
        pose = cameras.cam_world_to_opengl(camera.T_cam_world)
        lens = {
            "yfov": 2 * float(np.arctan(0.5 * camera.height / camera.intrinsics[1, 1])),
            "aspectRatio": float(camera.width * camera.intrinsics[1, 1] / (camera.height * camera.intrinsics[0, 0])),
            "znear": float(scene.near_plane),
        }
        tree.cameras.append({"type": "perspective", "perspective": lens})
        place, turn = pose[:3, 3].tolist(), _xyzw(pose[:3, :3])
        extras = {"r5dgs": {"camera": number}}
        name = f"camera {camera.name or number}"
        tree.roots.append(tree.add(name, None, translation=place, rotation=turn, camera=number, extras=extras))


def _xyzw(rotation: np.ndarray) -> list[float]:
    return rotations.rotmats_to_quats(rotation)[[1, 2, 3, 0]].tolist()


FORMAT = registry.Format(
    name="glb",
    label="Animated glTF",
    suffix=gltf.SUFFIX,
    keeps="objects and parts as nodes with keys, Gaussians with harmonics, cameras, names, motion models and bands",
    loses="bending of Gaussians, identity encodings, embeddings, needs table, provenance",
    write=export,
    has_motion=True,
    losses=losses,
)

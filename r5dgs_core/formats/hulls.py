"""Convex hulls of objects as meshes, in binary glTF: one named mesh for each object and motion group, y up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files
from ..scene.scene import Scene
from . import gltf, registry, rigid_bodies

_Y_UP = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # rotation from z up, xyzw


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the hulls at each time. Implements `registry.Format.write`."""
    for t, target in zip(options.times, FORMAT.paths(path, options, scene), strict=True):
        arrays, nodes, meshes = gltf.Arrays(), [], []
        for body in rigid_bodies.of(scene, t, options):
            place: dict[str, Any] = {
                "translation": body.position.tolist(),
                "rotation": body.quat[[1, 2, 3, 0]].tolist(),
            }
            nodes.append({"name": body.name, "mesh": len(meshes), **place})
            corners = arrays.add(body.solid.vertices, vertices=True, bounds=True)
            triangles = arrays.add(body.solid.triangles.astype(np.uint32).ravel())
            meshes.append(
                {"name": body.name, "primitives": [{"attributes": {"POSITION": corners}, "indices": triangles}]}
            )
        nodes.append({"name": scene.name, "rotation": _Y_UP, "children": list(range(len(nodes)))})
        content = {
            "asset": {"version": "2.0", "generator": "r5dgs"},
            "scene": 0,
            "scenes": [{"name": scene.name, "nodes": [len(nodes) - 1]}],
            "nodes": nodes,
            "meshes": meshes,
        }
        with registry.writing(target), atomic_files.replacing(target) as stream:
            gltf.write(stream, content, arrays)
        yield target


FORMAT = registry.Format(
    name="hulls",
    label="Convex Hulls",
    suffix=gltf.SUFFIX,
    keeps="convex hull of each object or part at one time as a named mesh, in metres if known; one file per frame",
    loses="Gaussians, colours, motion between frames, concave shapes, cameras",
    write=export,
    per_frame=True,
    losses=rigid_bodies.losses,
    extra="contact",
    packages=("scipy",),
)

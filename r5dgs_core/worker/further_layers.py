"""Layers of a picture besides those of the rasterizer: shares of groups, and Gaussians in front of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..protocol.meshes import Meshes
from ..protocol.messages import Coverage, RenderRequest
from ..scene.instance import Instance
from ..scene.scene import Scene

if TYPE_CHECKING:
    from ..render.incremental_renderer import IncrementalRenderer


def draw(
    stage: IncrementalRenderer, wanted: RenderRequest, instances: Sequence[Instance], scenes: Sequence[Scene]
) -> dict[str, np.ndarray]:
    """Return the requested layers by name.

    Args:
        stage: Renderer of the scenes.
        wanted: The request.
        instances: Its instances, with the rows of edited ones.
        scenes: Scenes that they refer to.
    """
    layers = {} if wanted.coverage is None else _coverage(stage, wanted, wanted.coverage, instances)
    return (
        layers
        if wanted.meshes is None
        else {**layers, "front": _front(stage, wanted, wanted.meshes, instances, scenes)}
    )


def _coverage(
    stage: IncrementalRenderer, wanted: RenderRequest, coverage: Coverage, instances: Sequence[Instance]
) -> dict[str, np.ndarray]:
    """Groups of instances that share each pixel, and their shares."""
    found, shares = stage.coverage(instances, coverage.groups, wanted.camera, ranks=coverage.ranks, near=wanted.near)
    return {"coverage_groups": found, "coverage": shares}


def _front(
    stage: IncrementalRenderer,
    wanted: RenderRequest,
    meshes: Meshes,
    instances: Sequence[Instance],
    scenes: Sequence[Scene],
) -> np.ndarray:
    """Gaussians in front of meshes, without those of the sky. [H, W, 4]"""
    from ..render import front_layer, mesh_depths

    posed, settings = stage.posed(instances, wanted.near)
    depths = mesh_depths.draw(wanted.camera, meshes.vertices, meshes.triangles, settings.near_plane)
    return front_layer.render(
        posed, wanted.camera, depths, settings, front_layer.sky_mask(scenes, instances, posed, wanted.camera)
    )

"""Render requests, one class for both ends: Blender writes them by `to_json`, the worker reads them by `from_json`.

`contacts` has the class of contact requests. The worker reads the fields of all other requests by `fields`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..scene.cameras import Camera
from ..scene.instance import Instance, Sky
from . import fields
from .meshes import Meshes

VERSION = 6  # of the protocol; the worker reports it in its answer to "hello"


@dataclass(frozen=True)
class Coverage:
    """Request for the groups of instances that share each pixel.

    Attributes:
        groups: Group of each instance, -1 for none.
        ranks: Number of groups kept per pixel.
    """

    groups: Sequence[int]
    ranks: int

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return {"groups": list(self.groups), "ranks": self.ranks}


@dataclass(frozen=True)
class RenderRequest:
    """Picture of the loaded scenes, as instances or, with ``t``, of one scene by playback in its own world.

    Attributes:
        camera: The camera, OpenCV axes, in the world of the picture.
        instances: Visible ranges of Gaussians. A hold-out is black and appears in no array but ``holdout``. Rows of an
            edited range are unknown to Blender and 0.
        edits: Key of the point edit that replaces the rows of each instance, or None. An edit is sent before, by a
            ``points`` request.
        t: Scene time for playback; None for instances.
        scene: Scene of the playback.
        sky: Sky behind everything; None for black.
        near: Nearest depth to render; None for the near plane of each scene.
        distance: Offset from the camera at which depth starts.
        want: Names of further arrays: any of ``depth alpha owners holdout``, for playback of ``depth alpha ids``.
            ``owners`` and ``ids`` are the instance or object with the largest share of each pixel, -1 for none.
        meshes: Meshes in the world of the picture; adds the array ``front``, the Gaussians in front of them. None to
            leave it out.
        coverage: Adds the arrays ``coverage_groups`` and ``coverage``; None to leave them out.
    """

    camera: Camera
    instances: tuple[Instance, ...] = ()
    edits: tuple[str | None, ...] = ()
    t: float | None = None
    scene: int = 0
    sky: Sky | None = None
    near: float | None = None
    distance: float = 0.0
    want: tuple[str, ...] = ()
    coverage: Coverage | None = None
    meshes: Meshes | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the fields of the request as JSON values."""
        sky = None if self.sky is None else {"scene": self.sky.scene, "matrix": self.sky.matrix.tolist()}
        result = {"camera": camera_to_json(self.camera), "sky": sky, "near": self.near, "want": list(self.want)}
        if self.t is None:
            entries = zip(self.instances, self.edits, strict=True)
            result |= {"instances": [_instance_to_json(*entry) for entry in entries], "distance": self.distance}
        else:
            result |= {"t": self.t, "scene": self.scene}
        result |= {} if self.meshes is None else {"meshes": self.meshes.to_json()}
        return result if self.coverage is None else {**result, "coverage": self.coverage.to_json()}

    @classmethod
    def from_json(cls, request: dict[str, Any], numbers: Sequence[int]) -> RenderRequest:
        """Check and convert a received request.

        Args:
            request: The request.
            numbers: Scene number of each loaded path. Scene indices of the request refer to paths, those of the result
                to loaded scenes.

        Raises:
            ConfigError: A field is invalid; the message names it.
        """
        camera = fields.camera_of(fields.need(request, "camera", dict))
        moved = "instances" in request
        want = fields.wanted(request, ("alpha", "depth", *(("owners", "holdout") if moved else ("ids",))))
        near, coverage = fields.near_of(request), fields.coverage_of(request)
        covered = None if coverage is None else Coverage(*coverage)
        if not moved:
            t, scene = fields.time_of(request), fields.number_of(request, numbers)
            sky = Sky(scene) if request.get("sky", {}) is not None else None
            return cls(camera, t=t, scene=scene, sky=sky, near=near, want=tuple(want), coverage=covered)
        entries = fields.need(request, "instances", list)
        return cls(
            camera,
            tuple(fields.instance_of(entry, numbers) for entry in entries),
            tuple(fields.edit_of(entry) for entry in entries),
            sky=fields.sky_of(request, numbers),
            near=near,
            distance=fields.distance_of(request),
            want=tuple(want),
            coverage=covered,
            meshes=None if request.get("meshes") is None else Meshes.from_json(request["meshes"]),
        )


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as JSON values, without its name."""
    return {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": camera.intrinsics.tolist(),
        "T_cam_world": camera.T_cam_world.tolist(),
    }


def _instance_to_json(instance: Instance, edit: str | None) -> dict[str, Any]:
    entry: dict[str, Any] = {"scene": instance.scene, "matrix": instance.matrix.tolist()}
    if instance.world is not None:
        entry["world"] = np.asarray(instance.world).tolist()
    entry |= {"start": instance.start, "count": instance.count} if edit is None else {"points": edit}
    if instance.tint not in (None, (1.0, 1.0, 1.0)):
        entry["tint"] = list(instance.tint)
    if instance.t is not None:
        entry["t"] = instance.t
    if instance.holdout:
        entry["holdout"] = True
    return entry

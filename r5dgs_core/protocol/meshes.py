"""Triangle meshes of a render request."""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import errors
from ..scene import cameras


@dataclass(frozen=True)
class Meshes:
    """Meshes that hide Gaussians.

    Attributes:
        vertices: Corners, in the world of the picture. [V, 3] float32
        triangles: Corners of each triangle. [T, 3] int32
    """

    vertices: np.ndarray
    triangles: np.ndarray

    def to_json(self) -> dict[str, str]:
        """Return JSON values: base64 of both arrays."""
        return {
            "vertices": base64.b64encode(np.ascontiguousarray(self.vertices, "<f4").data).decode(),
            "triangles": base64.b64encode(np.ascontiguousarray(self.triangles, "<i4").data).decode(),
        }

    @classmethod
    def from_json(cls, value: Any) -> Meshes:
        """Check and convert received values. Raises ConfigError."""
        if not isinstance(value, dict) or set(value) != {"vertices", "triangles"}:
            raise errors.ConfigError("worker: 'meshes' has to be null or vertices and triangles")
        vertices, triangles = _rows(value, "vertices", "<f4"), _rows(value, "triangles", "<i4")
        if not (np.abs(vertices) <= cameras.FARTHEST).all():
            raise errors.ConfigError(f"worker: 'vertices' of meshes has to hold numbers up to {cameras.FARTHEST:g}")
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
            raise errors.ConfigError(f"worker: 'triangles' of meshes has to hold indices below {len(vertices)}")
        return cls(vertices, triangles)


def _rows(value: dict[str, Any], name: str, dtype: str) -> np.ndarray:
    """Decode an array of three columns. [n, 3]"""
    try:
        return np.frombuffer(base64.b64decode(value[name], validate=True), dtype).reshape(-1, 3)
    except (TypeError, ValueError, binascii.Error):
        raise errors.ConfigError(f"worker: '{name}' of meshes has to be base64 of rows of three {dtype}") from None

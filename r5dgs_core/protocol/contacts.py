"""Request for predicted motions with contacts, one class for Blender and the worker."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .. import errors
from ..scene import cameras
from . import fields

_MOST = 1e9  # of friction, mass and gravity
_FACTORS = {"friction": (0.0, _MOST), "restitution": (0.0, 1.0), "mass": (1e-9, _MOST)}


@dataclass(frozen=True)
class ContactRequest:
    """Prediction of the motions of a scene file past t_max.

    Attributes:
        scene: Path of the file.
        until: Scene time up to which contacts are searched.
        frictions: Coulomb friction by motion group. Other groups keep the fitted one.
        restitutions: Coefficients of restitution by motion group, likewise.
        masses: Factors of the mass by motion group; without one, the mass is proportional to the volume.
        gravity: Downward acceleration along the up axis of the world, scene units; None for that of the scene.
        obstacles: Corners of fixed convex bodies by name, world of the scene. [V, 3] each
    """

    scene: str
    until: float
    frictions: Mapping[int, float] = field(default_factory=dict)
    restitutions: Mapping[int, float] = field(default_factory=dict)
    masses: Mapping[int, float] = field(default_factory=dict)
    gravity: float | None = None
    obstacles: Mapping[str, np.ndarray] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the fields of the request as JSON values."""
        named = zip(_FACTORS, (self.frictions, self.restitutions, self.masses), strict=True)
        bodies: dict[int, dict[str, float]] = {}
        for name, values in named:
            for group, value in values.items():
                bodies.setdefault(group, {})[name] = value
        return {
            "scene": self.scene,
            "until": self.until,
            "bodies": [{"group": group, **values} for group, values in bodies.items()],
            "gravity": self.gravity,
            "obstacles": [
                {"name": name, "corners": base64.b64encode(np.ascontiguousarray(corners, "<f8").data).decode()}
                for name, corners in self.obstacles.items()
            ],
        }

    @classmethod
    def from_json(cls, request: dict[str, Any]) -> ContactRequest:
        """Check and convert a received request. Raises ConfigError naming the field."""
        found: dict[str, dict[int, float]] = {name: {} for name in _FACTORS}
        for body in fields.need(request, "bodies", list):
            if not isinstance(body, dict) or not isinstance(body.get("group"), int) or set(body) - {"group", *_FACTORS}:
                raise errors.ConfigError("worker: 'bodies' has to hold groups with friction, restitution and mass")
            for name in _FACTORS.keys() & body.keys():
                found[name][body["group"]] = _number(body[name], name, *_FACTORS[name])
        gravity, obstacles = request.get("gravity"), {}
        for one in fields.need(request, "obstacles", list):
            if not isinstance(one, dict) or not isinstance(one.get("name"), str) or set(one) != {"name", "corners"}:
                raise errors.ConfigError("worker: 'obstacles' has to hold names and corners")
            obstacles[one["name"]] = _corners(one["corners"])
        return cls(
            fields.path_of(request.get("scene"), "contact"),
            _number(request.get("until"), "until", -cameras.FARTHEST, cameras.FARTHEST),
            found["friction"],
            found["restitution"],
            found["mass"],
            None if gravity is None else _number(gravity, "gravity", -_MOST, _MOST),
            obstacles,
        )


def _number(value: Any, name: str, least: float, most: float) -> float:
    if not fields.is_number(value) or not least <= value <= most:
        raise errors.ConfigError(f"worker: {name!r} has to be a number from {least:g} to {most:g}, found {value!r:.60}")
    return float(value)


def _corners(text: Any) -> np.ndarray:
    """Decode corners. [V, 3]"""
    try:
        corners = np.frombuffer(base64.b64decode(text, validate=True), "<f8").reshape(-1, 3)
    except (TypeError, ValueError, binascii.Error):
        raise errors.ConfigError("worker: 'corners' has to be base64 of rows of three <f8") from None
    if not (np.abs(corners) <= cameras.FARTHEST).all():
        raise errors.ConfigError(f"worker: 'corners' has to hold numbers up to {cameras.FARTHEST:g}")
    return corners

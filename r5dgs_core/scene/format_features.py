"""Optional and required features of scene files with format version 2.

``scene.json`` lists them:

    "features": [{"name": "origin", "required": true, "since": "0.2.0"}]

A reader rejects a file with a required feature that it does not support, and skips an optional one.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from typing import Any

from .. import __version__, errors
from . import hull_json, quantised_arrays, scene_json
from .scene import Scene

VERSIONS = (1, 2)  # format versions that this release reads
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_RELEASE = re.compile(r"[0-9]{1,4}(\.[0-9]{1,4}){1,3}")


@dataclass(frozen=True)
class Feature:
    """One entry of ``features``.

    Attributes:
        name: Lower case, with underscores.
        required: True if a reader without the feature would misread the scene.
        since: First release that supports it.
    """

    name: str
    required: bool
    since: str


ORIGIN = Feature("origin", required=True, since="0.2.0")
MOTIONS = Feature("motions", required=True, since="0.2.0")
EVENTS = Feature("events", required=False, since="0.2.0")
PARTS = Feature("parts", required=False, since="0.2.0")
HULLS = Feature("hulls", required=False, since="0.2.0")
TRAJECTORY = Feature("trajectory", required=False, since="0.2.0")
QUANTISED = Feature("quantised", required=True, since="0.2.0")
ABSENCE = Feature("absence", required=False, since="0.2.0")
_KNOWN_NAMES = {one.name for one in (ORIGIN, MOTIONS, EVENTS, PARTS, HULLS, TRAJECTORY, QUANTISED, ABSENCE)}


def _used(scene: Scene, quantised: bool) -> list[Feature]:
    """Features that a scene and its stored form need."""
    found = [ORIGIN] if scene.origin.any() else []
    found += [MOTIONS] if any(not (group.smooth or group.model).is_basic for group in scene.groups) else []
    found += [EVENTS] if any(group.history.events for group in scene.groups) else []
    found += [PARTS] if any(group.joint is not None for group in scene.groups) else []
    found += [HULLS] if scene.hulls else []
    found += [TRAJECTORY] if any(group.smooth is not None for group in scene.groups) else []
    found += [ABSENCE] if any(group.absent for group in scene.groups) else []
    return found + ([QUANTISED] if quantised else [])


def version(scene: Scene, quantised: bool = False) -> int:
    """Lowest format version that can store a scene, or its quantised form."""
    return 2 if _used(scene, quantised) else 1


def to_json(scene: Scene, steps: quantised_arrays.Steps | None = None) -> dict[str, Any]:
    """Features of a scene and their entries in ``scene.json``; empty if version 1 suffices.

    Args:
        scene: The scene.
        steps: Steps of its quantised form; None for the other precisions.
    """
    used = _used(scene, steps is not None)
    if not used:
        return {}
    origin = {"origin": scene.origin.tolist()} if ORIGIN in used else {}
    hulls = {"hulls": hull_json.to_json(scene)} if HULLS in used else {}
    quantised = {} if steps is None else {"quantised": steps.to_json()}
    return {"features": [asdict(feature) for feature in used], **origin, **hulls, **quantised}


def fields(top: scene_json.Row) -> dict[str, Any]:
    """Fields of `Scene` that belong to the features of a checked file. Raises as `check` does."""
    names = _names(top.data)
    origin = {"origin": top.numbers("origin", (3,))} if ORIGIN.name in names else {}
    return origin | ({"hulls": top.each("hulls", hull_json.read)} if HULLS.name in names else {})


def is_quantised(data: dict[str, Any]) -> bool:
    """True if a checked file stores its arrays in quantised form."""
    return QUANTISED.name in _names(data)


def skipped(data: dict[str, Any]) -> list[str]:
    """Names of optional features of a checked file that this release does not support."""
    return [name for name in _names(data) if name not in _KNOWN_NAMES]


def check(data: dict[str, Any], place: str) -> None:
    """Check the format version and the features of a file.

    Args:
        data: Content of ``scene.json``.
        place: File and member, for messages.
    """
    found = data.get("format_version")
    if found not in VERSIONS or not isinstance(found, int) or isinstance(found, bool):
        newer = isinstance(found, int) and found > VERSIONS[-1]
        remedy = "update R5DGS" if newer else "bake the scene again"
        wanted = " or ".join(map(str, VERSIONS))
        raise errors.SceneFileError(f"{place}: expected format_version {wanted}, found {found!r:.60}; {remedy}")
    if found == 1:
        return
    listed = scene_json.Row(data, place).each("features", _read)
    names = [feature.name for feature in listed]
    if len(set(names)) != len(names):
        raise errors.SceneFileError(f"{place}: features: expected each name once, found {names!s:.60}")
    lacking = [feature for feature in listed if feature.required and feature.name not in _KNOWN_NAMES]
    if lacking:
        words = ", ".join(f"{feature.name!r} (since R5DGS {feature.since})" for feature in lacking[:5])
        newest = max((feature.since for feature in lacking), key=lambda since: tuple(map(int, since.split("."))))
        raise errors.SceneFileError(
            f"{place}: the scene requires features that R5DGS {__version__} lacks: {words}; "
            f"update R5DGS to {newest} or later"
        )


def _names(data: dict[str, Any]) -> list[str]:
    return [row["name"] for row in data["features"]] if data["format_version"] > 1 else []


def _read(row: scene_json.Row) -> Feature:
    name, since, place = row.get("name", str), row.get("since", str), row.place
    if not _NAME.fullmatch(name):
        raise errors.SceneFileError(f"{place}: name: expected letters a-z, digits and underscores, found {name!r:.60}")
    if not _RELEASE.fullmatch(since):
        raise errors.SceneFileError(f"{place}: since: expected a release such as '0.2.0', found {since!r:.60}")
    return Feature(name, row.get("required", bool), since)

"""Annotations of a data set's objects: names (``objects.json``) and true poses (``ground_truth.json``)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import errors, findings, strict_json
from . import masks

OBJECTS = "objects.json"


@dataclass(frozen=True)
class GroundTruth:
    """True poses of the objects.

    Attributes:
        times: Times of the poses, increasing. [T]
        object_ids: Ids, in the order of ``matrices``; an object of several rigid bodies has one entry for each. (M,)
        names: Names, in the same order. (M,)
        matrices: Object to world. [M, T, 4, 4]
        t_max: Last observed time according to the capture.
    """

    times: np.ndarray
    object_ids: tuple[int, ...]
    names: tuple[str, ...]
    matrices: np.ndarray
    t_max: float

    def moved(self, shift: np.ndarray) -> GroundTruth:
        """Translate all poses by a vector [3]."""
        matrices = self.matrices.copy()
        matrices[..., :3, 3] += shift
        return replace(self, matrices=matrices)


def read_objects(
    root: Path, guard: findings.Guard = findings.STRICT
) -> tuple[dict[int, str], dict[int, tuple[str, ...]]]:
    """Read ``objects.json``: ``{"1": "mug"}`` or ``{"1": {"name": "mug", "aliases": ["cup"]}}``.

    Args:
        root: Folder of the file.
        guard: Entered around each entry.

    Returns:
        Name and aliases of each id; empty without the file.
    """
    path = root / OBJECTS
    names: dict[int, str] = {}
    aliases: dict[int, tuple[str, ...]] = {}
    if not path.exists():
        return names, aliases
    content = strict_json.read(path, errors.DatasetError)
    if not isinstance(content, dict):
        raise errors.DatasetError(f'{path}: expected an object such as {{"1": "mug"}}, found {type(content).__name__}')
    for key, value in content.items():
        with guard(), findings.coded("D20"):
            entry = {"name": value} if isinstance(value, str) else value
            if not key.isdecimal():
                raise errors.DatasetError(f"{path}: expected object ids as keys, found {key!r}")
            if int(key) > masks.MAX_ID:
                raise errors.DatasetError(
                    f"{path}: expected object ids up to {masks.MAX_ID}, which masks of 16 bits hold, found {key}"
                )
            words = entry.get("aliases", []) if isinstance(entry, dict) else None
            if (
                not isinstance(entry, dict)
                or not isinstance(entry.get("name"), str)
                or not entry["name"].strip()
                or not isinstance(words, list)
                or not all(isinstance(word, str) for word in words)
            ):
                raise errors.DatasetError(f'{path}: {key!r}: expected a name or {{"name": ..., "aliases": [...]}}')
            if entry["name"] in names.values():
                raise errors.DatasetError(
                    f"{path}: {key!r}: the name {entry['name']!r} is used twice; make names unique"
                )
            names[int(key)] = entry["name"]
            if words:
                aliases[int(key)] = tuple(words)
    return names, aliases


def read_ground_truth(root: Path) -> GroundTruth | None:
    """Read ``ground_truth.json``; returns None without the file."""
    path = root / "ground_truth.json"
    if not path.exists():
        return None
    content = strict_json.read(path, errors.DatasetError)
    try:
        times = np.array(content["times"], np.float64)
        ids = tuple(int(item["id"]) for item in content["objects"])
        names = tuple(str(item["name"]) for item in content["objects"])
        matrices = np.array([item["matrices"] for item in content["objects"]], np.float64)
        matrices = matrices.reshape(len(ids), len(times), 4, 4)
        t_max = float(content["t_max"])
    except (KeyError, TypeError, ValueError) as error:
        raise errors.DatasetError(
            f"{path}: expected 't_max', 'times' and 'objects' of 'id', 'name' and one 4x4 of 'matrices' per time "
            f"({type(error).__name__}: {error})"
        ) from error
    if times.ndim != 1 or not (np.isfinite(matrices).all() and np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise errors.DatasetError(f"{path}: expected finite poses at increasing times")
    if len(set(zip(ids, names, strict=True))) != len(ids):
        raise errors.DatasetError(f"{path}: an object id appears twice; give the parts of an object different names")
    return GroundTruth(times, ids, names, matrices, t_max)

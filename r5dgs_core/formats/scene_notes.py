"""Notes of a scene in files of other formats, for our own programs: names, groups, models, cameras, bands as JSON.

They have the entries of ``scene.json`` and further ones for times, sky and stored words.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .. import __version__, errors
from ..playback import group_dynamics
from ..scene import format_features, motion_words, predictability, scene_json, validation
from ..scene.json_row import Row
from ..scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Shading, Tracks
from ..scene.stored_embeddings import StoredEmbeddings
from ..scene.units import Units
from ..search import embedding_search


@dataclasses.dataclass(frozen=True)
class Kind:
    """Kind of a file: its name and version, and the command that writes it."""

    name: str
    version: int
    command: str


def of(scene: Scene, end: float, kind: Kind) -> dict[str, Any]:
    """Notes about a scene whose motion ends at a scene time, as JSON types."""
    bare = dataclasses.replace(scene, provenance={}, needs=(), vocabulary=(), lookup=None, hulls=())
    head = {"format": kind.name, "format_version": kind.version, "scene_version": format_features.version(bare)}
    tree = json.loads(scene_json.dump(bare, head | format_features.to_json(bare)))
    outlooks = predictability.outlooks(scene)
    for item in tree["objects"]:
        item["motion"] = motion_words.motion_of(scene, scene.bodies(item["id"]))
        item["prediction"] = outlooks[item["id"]].prediction()
    return tree | {
        "track_times": scene.tracks.times.tolist(),
        "end": float(end),
        "background_sh": scene.background_sh.astype(np.float64).tolist(),
        "words": _words(scene),
    }


def _words(scene: Scene) -> list[list[Any]]:
    """Stored words, each with the objects that it matches by meaning: id, score and cosine."""
    embeddings = StoredEmbeddings.of(scene)
    if embeddings is None:
        return []
    found = []
    for word, query in zip(embeddings.vocabulary, embeddings.vocabulary_embeddings, strict=True):
        answers = [one for one in embedding_search.ask(embeddings, query) if one.score >= embedding_search.PASS]
        found.append([word, [[one.object_id, one.score, one.cosine] for one in answers if one.object_id >= 0]])
    return found


def row(found: Any, kind: Kind, place: str) -> Row:
    """Typed access to notes. Raises `SceneFileError` if they are missing, or of another kind or version."""
    if not isinstance(found, dict) or found.get("format") != kind.name:
        raise errors.SceneFileError(f"{place}: expected a file of '{kind.command}', found none of its notes")
    if found.get("format_version") != kind.version:
        wanted = f"expected format_version {kind.version}, found {found.get('format_version')!r:.60}"
        raise errors.SceneFileError(f"{place}: {wanted}; update R5DGS")
    return Row(found | {"vocabulary": [], "needs": [], "provenance": {}}, place)


def to_scene(
    notes: Row,
    kind: Kind,
    path: str,
    gaussians: Callable[[Sequence[MotionGroup]], tuple[Gaussians, np.ndarray | None]],
    poses: Callable[[Sequence[MotionGroup], np.ndarray, Units], np.ndarray],
) -> Scene:
    """Scene of a file with notes.

    Args:
        notes: The notes, from `row`.
        kind: Kind of the file.
        path: The file.
        gaussians: Returns the Gaussians, and their shading vectors with factors at t_max [N, 4] or None.
        poses: Returns the poses of all groups at the observed times, as in `Tracks`. [G, S, 7]

    Raises:
        SceneFileError: The notes are damaged, or the scene is not valid.
    """
    fields = scene_json.fields(notes)
    version = {"format_version": notes.get("scene_version", int)}
    features = Row(notes.data | version, notes.place)
    format_features.check(features.data, notes.place)
    fields |= format_features.fields(features)
    groups, times = fields["groups"], notes.numbers("track_times", (len(notes.get("track_times", list)),))
    if len(times) == 0 or [group.id for group in groups] != list(range(len(groups))):
        raise errors.SceneFileError(f"{notes.place}: expected observed times, and groups that are numbered from 0")
    found, shading = gaussians(groups)
    light = fields.pop("light_direction")
    sky = notes.numbers("background_sh", (len(notes.get("background_sh", list)), 3))
    scene = Scene(
        **fields
        | {
            "gaussians": found,
            "objects": _objects(fields["objects"], found.object_ids),
            "tracks": Tracks(times, poses(groups, times, fields["units"])),
            "background_sh": np.asarray(sky, np.float32),
            "shading": None if shading is None or light is None else _shading(shading, light),
            "provenance": {"imported": {"layout": kind.name, "file": path}, "versions": {"r5dgs": __version__}},
        }
    )
    scene = dataclasses.replace(scene, groups=tuple(_with_anchor(scene, group) for group in groups))
    validation.check(scene, path)
    return scene


def _objects(table: Sequence[SceneObject], ids: np.ndarray) -> tuple[SceneObject, ...]:
    """Table with the ranges of the Gaussians that the file holds."""
    starts, stops = (np.searchsorted(ids, [item.id for item in table], side=side) for side in ("left", "right"))
    rows = zip(table, starts.tolist(), stops.tolist(), strict=True)
    return tuple(dataclasses.replace(item, start=start, count=stop - start) for item, start, stop in rows)


def _shading(columns: np.ndarray, light: np.ndarray) -> Shading:
    rest = columns[:, 3]
    return Shading(columns[:, :3].copy(), light, rest.copy() if (rest != 1).any() else None)


def _with_anchor(scene: Scene, group: MotionGroup) -> MotionGroup:
    """Group with a representative among the Gaussians that the file holds."""
    rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
    if len(rows) and not (0 <= group.anchor_index < len(scene.gaussians.means) and group.anchor_index in rows):
        return dataclasses.replace(group, anchor_index=group_dynamics.representative(scene, rows))
    return group if len(rows) else dataclasses.replace(group, anchor_index=-1)

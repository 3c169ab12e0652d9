"""Reader of `.4dgs` files of `fourdgs_file`: scenes with rigid motion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, extras, strict_json
from ..motion import rotations
from ..scene import spherical_harmonics
from ..scene.json_row import Row
from ..scene.scene import Gaussians, MotionGroup, Scene
from ..scene.units import Units
from . import fourdgs_file, glb_motion, scene_notes

_SMALLEST, _LARGEST_LOGIT = 1e-30, 16.0
_WXYZ = [3, 0, 1, 2]


def read(path: str | Path) -> Scene:
    """Read and validate a scene. Raises `SceneFileError` naming the place, and BackendError without the library.

    Gaussians are read with the precision of the file; names, models and the rest come from its notes.
    """
    with extras.required(f"{path}", fourdgs_file.EXTRA):
        import fourdgs
    try:
        content = fourdgs.read(str(path), recover_truncated=False)
    except Exception as error:  # the library does not convert all errors of its parser
        raise errors.SceneFileError(f"{path}: cannot be read as 4dgs: {error or type(error).__name__}") from error
    place = f"{path}: header: {fourdgs_file.NOTES}"
    text = content.header.attributes.get(fourdgs_file.NOTES, "{}")
    notes = scene_notes.row(strict_json.parse(text.encode(), place, errors.SceneFileError), fourdgs_file.KIND, place)
    return scene_notes.to_scene(
        notes,
        fourdgs_file.KIND,
        str(path),
        lambda groups: (_gaussians(content, notes, groups), None),
        lambda groups, times, units: _poses(content, notes, groups, times, units),
    )


def _pieces(notes: Row, groups: Sequence[MotionGroup]) -> dict[int, tuple[int, int]]:
    """Object and motion group of each object of the file."""
    table = notes.numbers("pieces", (len(notes.get("pieces", list)), 3)).astype(np.int64)
    if len(table) and not (table[:, 2].min() >= 0 and table[:, 2].max() < len(groups)):
        raise errors.SceneFileError(f"{notes.place}: pieces: expected groups below {len(groups)}")
    return {number: (object_id, group) for number, object_id, group in table.tolist()}


def _gaussians(content: Any, notes: Row, groups: Sequence[MotionGroup]) -> Gaussians:
    """Gaussians in the order of a scene."""
    found, pieces = content.gaussians, _pieces(notes, groups)
    members = np.zeros(found.count, np.int64) if found.object_id is None else found.object_id.astype(np.int64)
    labels = np.zeros((found.count, 2), np.int64)
    for number in np.unique(members).tolist():
        if number:
            if number not in pieces:
                raise errors.SceneFileError(f"{notes.place}: pieces: expected an entry for object {number}")
            labels[members == number] = pieces[number]
    order = np.lexsort((labels[:, 1], labels[:, 0]))
    count = (found.sh_degree + 1) ** 2 - 1
    dc = spherical_harmonics.rgb_to_dc(found.colors[:, :3].astype(np.float64))[:, None]
    span = fourdgs_file.HIGH - fourdgs_file.LOW
    if count:
        rest = found.sh.reshape(found.count, 3, count).transpose(0, 2, 1) / 255 * span + fourdgs_file.LOW
        dc = np.concatenate([dc, rest], axis=1)
    edge = 1 / (1 + np.exp(_LARGEST_LOGIT))
    opacities = found.colors[:, 3].astype(np.float64).clip(edge, 1 - edge)
    columns = {
        "means": found.positions,
        "quats": rotations.normalize(found.rotations[:, _WXYZ].astype(np.float64)),
        "log_scales": np.log(found.scales.clip(_SMALLEST)),
        "opacity_logits": np.log(opacities / (1 - opacities)),
        "sh": dc,
    }
    return Gaussians(
        **{name: np.ascontiguousarray(values[order], np.float32) for name, values in columns.items()},
        object_ids=labels[order, 0].astype(np.int32),
        motion_ids=labels[order, 1].astype(np.int32),
    )


def _poses(
    content: Any, notes: Row, groups: Sequence[MotionGroup], times: np.ndarray, units: Units
) -> np.ndarray:  # [G, S, 7]
    """Poses of all groups at the observed times."""
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(groups), len(times), 1))
    seconds = glb_motion.seconds_per_unit(units) * (times - times[0])
    for number, (_, group) in _pieces(notes, groups).items():
        found = [content.objects.pose_at(number, t) for t in seconds.tolist()]
        if group and found and all(pose is not None for pose in found):
            quats = rotations.normalize(np.array([pose.rotation for pose in found])[:, _WXYZ])
            quats = rotations.make_continuous(quats[::-1])[::-1]
            pivot = groups[group].pivot
            moves = np.array([pose.translation for pose in found]) + rotations.rotate(quats, pivot) - pivot
            poses[group] = np.concatenate([quats, moves], axis=-1)
    poses[:, -1] = [1, 0, 0, 0, 0, 0, 0]
    return poses

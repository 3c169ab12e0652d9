"""Scenes as 4dgs files: an Object Table of pieces that move together, with SE(3) tracks (docs/reference/4dgs.md).

The Gaussians are those of t_max. Each piece of a scene that moves, or belongs to an object, is an object of the file;
static Gaussians of the background are 0. A track maps the world at t_max to the world at a time, x' = R x + T.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, extras
from ..motion import rotations
from ..playback import group_curves, played_splats
from ..playback.group_dynamics import GroupMotion
from ..playback.scene_player import Player, available
from ..scene import presence, spherical_harmonics
from ..scene.scene import Scene
from ..scene.splats import Splats, to_opacities
from . import glb_motion, linear_times, registry, scene_nodes, scene_notes

EXTRA, PACKAGE = "export", "fourdgs"
KIND = scene_notes.Kind("r5dgs 4dgs", 1, "r5dgs export --to 4dgs")
NOTES = "r5dgs"  # key of the header's attributes
LOW, HIGH = -4.0, 4.0  # range of harmonics of degree 1 and more
_ROUNDING = 1 / 510  # of stored colours
_XYZW = [1, 2, 3, 0]
_UP = {"blender": "z-up-right-handed", "colmap": "y-down-right-handed", "opengl": "y-up-right-handed"}


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write a scene with its motion. Implements `registry.Format.write`."""
    with extras.required("4dgs files", EXTRA):
        import fourdgs
    pieces = scene_nodes.pieces(scene, options.object_ids)
    start = float(scene.tracks.times[0])
    end = scene_nodes.end(scene, options)
    ids = {(piece.object_id, piece.group): number for number, piece in enumerate(_numbered(pieces), 1)}
    rows = np.concatenate([np.arange(piece.rows.start, piece.rows.stop) for piece in pieces])
    members = np.concatenate([np.full(p.rows.stop - p.rows.start, ids.get(p[1:], 0)) for p in pieces])
    splats = _bound(scene, None)
    windows = _windows(scene, end)[scene.gaussians.motion_ids[rows]]
    gaussians = _gaussians(fourdgs, Splats(**{f: getattr(splats, f)[rows] for f in _FIELDS}), members, windows)
    poses_at = functools.cache(GroupMotion(scene).poses)  # of all groups; their tracks share most times
    moving = {group: _track(scene, poses_at, group, end) for group in {piece.group for piece in pieces} - {0}}
    names = {item.id: item.name for item in scene.objects}
    layer = fourdgs.ObjectLayer(
        table=fourdgs.ObjectTable(
            entries=[
                fourdgs.ObjectTableEntry(object_id=k, label=names[o], anchor=tuple(scene.groups[g].home.tolist()))
                for (o, g), k in ids.items()
            ]
        ),
        tracks=[
            fourdgs.ObjectTrack(object_id=k, times=times, rotations=turns, translations=moves)
            for (_, g), k in ids.items()
            if g in moving
            for times, turns, moves in [moving[g]]
        ],
    )
    settings = fourdgs.WriteOptions(profile="fine", objects=layer, metadata=_attributes(scene, end, ids))
    duration = glb_motion.seconds_per_unit(scene.units) * (end - start)
    with registry.writing(path, (fourdgs.FourdgsError,)), atomic_files.replacing_by_name(path) as temporary:
        fourdgs.write(str(temporary), gaussians, duration, options=settings)
    yield path


_FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def _numbered(pieces: list[scene_nodes.NodePiece]) -> list[scene_nodes.NodePiece]:
    """Pieces with an id of their own: all but static Gaussians of the background."""
    return [piece for piece in pieces if piece.group or piece.object_id]


def _bound(scene: Scene, object_ids: Collection[int] | None) -> Splats:
    """Gaussians at t_max, also of groups that are absent then."""
    groups = tuple(dataclasses.replace(group, absent=()) for group in scene.groups)
    return played_splats.at(Player(dataclasses.replace(scene, groups=groups)), scene.t_max, object_ids)


def _windows(scene: Scene, end: float) -> np.ndarray:
    """Seconds since the first observed time from which and until which each group is visible. [G, 2]"""
    spans = np.array([presence.span(group.absent) for group in scene.groups])
    found = glb_motion.seconds_per_unit(scene.units) * (spans - scene.tracks.times[0])
    return np.stack([found[:, 0].clip(0), np.where(spans[:, 1] > end, np.inf, found[:, 1])], axis=-1)


def _gaussians(fourdgs: Any, splats: Splats, members: np.ndarray, windows: np.ndarray) -> Any:
    """The Gaussians as ``fourdgs.GaussianSet``, visible from the first to the second of ``windows``. [N, 2]"""
    count, degree = len(splats.means), int(np.sqrt(splats.sh.shape[1])) - 1
    rgb = spherical_harmonics.dc_to_rgb(splats.sh[:, 0].astype(np.float64)).clip(0, 1)
    zeros = np.zeros(count, np.float32)
    stored = np.rint((splats.sh[:, 1:] - LOW) / (HIGH - LOW) * 255).clip(0, 255).astype(np.uint8)
    return fourdgs.GaussianSet(
        positions=splats.means,
        scales=np.exp(splats.log_scales),
        rotations=splats.quats[:, _XYZW],
        colors=np.concatenate([rgb, to_opacities(splats.opacity_logits)[:, None]], axis=1).astype(np.float32),
        motions=np.zeros((count, 3), np.float32),
        mu_t=zeros,
        sigma_t=zeros + np.inf,
        win_lo=windows[:, 0].copy(),
        win_hi=windows[:, 1].copy(),
        sh=stored.transpose(0, 2, 1).reshape(count, -1) if degree else None,
        sh_degree=degree,
        object_id=members.astype(np.int64),
    )


def _track(
    scene: Scene, poses_at: Callable[[float], tuple[np.ndarray, np.ndarray]], group: int, end: float
) -> tuple[list[float], list[list[float]], list[list[float]]]:
    """Seconds since the first observed time, rotations xyzw and translations of a group's track."""
    pivot = scene.groups[group].pivot

    def sample(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = [poses_at(t) for t in times.tolist()]
        quats, moves = np.array([q[group] for q, _ in poses]), np.array([d[group] for _, d in poses])
        return quats, pivot + moves - rotations.rotate(quats, pivot)

    first, number, reaches = np.asarray(scene.tracks.times), group, group_curves.reaches(scene)
    while True:  # keys of the group and of those that carry it
        curves = group_curves.curves(scene, number, end, float(reaches[number]))
        first = np.union1d(first, np.concatenate([curves.location.times, curves.rotation.times]))
        parent = scene.groups[number].parent
        if parent is None:
            break
        number = parent
    members = scene.gaussians.means[scene.gaussians.motion_ids == group]
    reach = float(np.linalg.norm(members, axis=-1).max())  # the track turns about the origin
    times = linear_times.refine(sample, first, linear_times.TOLERANCE * scene.extent, reach)
    quats, moves = sample(times)
    seconds = glb_motion.seconds_per_unit(scene.units) * (times - scene.tracks.times[0])
    return seconds.tolist(), quats[:, _XYZW].tolist(), moves.tolist()


def _attributes(scene: Scene, end: float, ids: dict[tuple[int, int], int]) -> dict[str, str]:
    """Attributes of the header: conventions by the names of the library, and notes for our own programs."""
    plain = dataclasses.replace(scene, shading=None, residuals=None, dynamics=None)
    notes = scene_notes.of(plain, end, KIND) | {"pieces": [[k, o, g] for (o, g), k in ids.items()]}
    size = scene.units.meters_per_unit
    return {
        "coordinate_system": _UP[scene.world_convention],
        "color_space": "srgb-rec709-display",
        **({} if size is None else {"meters_per_unit": repr(size)}),
        NOTES: json.dumps(notes, separators=(",", ":"), allow_nan=False),
    }


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that a file does not hold, or that only our own programs read, as sentences."""
    found = scene_nodes.lost_bending(scene, options.object_ids)
    if available(scene, "standard"):
        found.append("motion of single Gaussians past t_max (modes standard and hybrid)")
    if scene.shading is not None:
        found.append("colours other than those of t_max")
    dc = spherical_harmonics.dc_to_rgb(_bound(scene, options.object_ids).sh[:, 0])
    outside = int(((dc < -_ROUNDING) | (dc > 1 + _ROUNDING)).any(1).sum())
    if outside:
        found.append(f"{outside} Gaussians have mean colours outside [0, 1], which are clipped")
    shown = scene_nodes.selected(scene, options.object_ids)
    clipped = int((np.abs(scene.gaussians.sh[shown, 1:]) > HIGH).any((1, 2)).sum())
    if clipped:
        found.append(f"{clipped} Gaussians have harmonics beyond {HIGH:g}, which are clipped")
    groups = (scene.groups[g] for g in np.unique(scene.gaussians.motion_ids[shown]))
    if any(np.isfinite(interval).all() for group in groups for interval in group.absent):
        found.append("absence of objects between their first entry and their last exit")
    if len(scene.background_sh) > 1 or scene.background_sh.any():
        found.append("the sky, in other programs")
    if scene.gaussians.identities is not None:
        found.append("identity encodings and their classifier")
    return found


FORMAT = registry.Format(
    name="4dgs",
    label="4DGS",
    suffix=".4dgs",
    keeps="objects with their tracks, Gaussians with harmonics (quantised), cameras, names, motion models and bands",
    loses="bending of Gaussians, changing shading, modes other than rigid, encodings, embeddings, provenance",
    write=export,
    has_motion=True,
    losses=losses,
    extra=EXTRA,
    packages=(PACKAGE,),
)

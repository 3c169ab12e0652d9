"""A checkpoint becomes a scene: the bind state at t_max, the tracks in the world, and a motion model per group.

Notation: in training a body moves x -> c + R_s (x - c) + d_s. With the bind state at the last knot T and any pivot p,
the same motion is x_bind -> p + Q_s (x_bind - p) + D_s with Q_s = R_s R_T^-1 and
D_s = c + d_s + Q_s (p - c - d_T) - p. Shading 1 + (R^T l - l) . g keeps its form when colours are taken at the bind
state: with b = 1 + (R_T^T l - l) . g the colour becomes colour * b and g becomes R_T g / b.
"""

from __future__ import annotations

import colorsys
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ..data import dataset as datasets
from ..data.dataset import Dataset
from ..errors import CheckpointError
from ..model import spherical_harmonics
from ..motion import fitting, rotations
from ..motion.models import MotionModel
from ..scene.scene import NEAR_PLANE, MotionGroup, Scene, SceneObject
from . import checkpoint, needs
from .normalization import Normalization
from .representation import tracks_of

MIN_BIND_FACTOR = 0.1


@dataclasses.dataclass(frozen=True)
class _Group:
    """A motion group on the way into the scene: its canonical centre, tracks [S, 4] and [S, 3], and members."""

    object_id: int
    role: str
    center: np.ndarray
    quats: np.ndarray
    displacements: np.ndarray
    members: np.ndarray
    observed: np.ndarray
    caster: int | None = None


def bake(run: checkpoint.Run, dataset: Dataset | None = None) -> Scene:
    """Turn the last checkpoint of a run into a scene.

    Args:
        run: A run folder; its training need not be finished.
        dataset: The data set, read from where the run found it if not given.

    Returns:
        The scene, in the world of the data set.

    Raises:
        CheckpointError, DatasetError: A file is missing or damaged.
    """
    dataset = dataset if dataset is not None else datasets.read(run.dataset_root)
    state = checkpoint.load(run.folder)
    tensors: dict[str, Any] = state["tensors"]
    norm = Normalization(np.array(state["origin"]), state["scale"])
    g = {n.removeprefix("gaussians."): t.numpy() for n, t in tensors.items() if n.startswith("gaussians.")}
    if not all(np.isfinite(a).all() for a in g.values()):
        raise CheckpointError(f"{run.folder}: the checkpoint holds values that are not finite; train again")
    groups = _groups(tensors, state["observed"].numpy(), g["motion_ids"], norm)
    light = tensors["light"].numpy().astype(np.float64)
    strength = max(float(np.linalg.norm(light)), 1e-12)
    light = light / strength
    labels = (
        tensors["labels"].numpy()
        if "labels" in tensors
        else np.where(g["motion_ids"] < len(tensors["object_ids"]), g["motion_ids"], 0)
    )
    object_ids = tensors["object_ids"].numpy()[labels].astype(np.int32)
    log_scales = g["log_scales"] + np.log(norm.scale)
    means = norm.points_to_world(g["means"])
    quats = rotations.normalize(g["quats"].astype(np.float64))
    sh = np.concatenate([g["sh"], g["sh_rest"]], axis=1).astype(np.float64)
    shading = strength * g["shading"].astype(np.float64)
    motion_ids = g["motion_ids"].astype(np.int32)
    opacities = 1 / (1 + np.exp(-g["opacity_logits"].astype(np.float64)))
    rows: list[MotionGroup] = []
    track_poses = []
    last = len(tensors["tracks.times"]) - 1
    for index, group in enumerate(groups):
        q, d, c = group.quats[last], group.displacements[last], group.center
        members = group.members
        means[members] = c + rotations.rotate(q, means[members] - c) + d
        quats[members] = rotations.multiply(q, quats[members])
        sh[members], shading[members] = _bind_shading(sh[members], shading[members], q, light)
        pivot = _pivot(means[members], opacities[members], c + d)
        relative = rotations.make_continuous(
            rotations.normalize(rotations.multiply(group.quats, rotations.conjugate(q)))
        )
        shift = c + group.displacements + rotations.rotate(relative, pivot - c - d) - pivot
        relative[last], shift[last] = [1.0, 0, 0, 0], 0.0
        if group.role == "pinned":
            shift[:] = 0.0
        track_poses.append(np.concatenate([relative, shift], axis=1))
        rows.append(_motion_group(index, group, tensors, pivot, relative, shift, means[members], opacities[members]))
    order = np.lexsort((motion_ids, object_ids))
    used_background = _background(tensors["background"].numpy())
    turning = [bool(np.abs(p[:, 1:4]).max() > 1e-3) for p in track_poses]
    decisions = needs.decide(rows, track_poses, motion_ids, shading, light, used_background, len(sh[0]), run.config)
    keep_shading = bool(run.config.train.shading and any(turning) and np.abs(shading).max() > 0)
    rank = np.argsort(order)
    rows = [
        dataclasses.replace(r, anchor_index=int(rank[np.flatnonzero(groups[r.id].members)[r.anchor_index]]))
        if r.anchor_index >= 0
        else r
        for r in rows
    ]
    return Scene(
        name=dataset.name,
        means=means[order].astype(np.float32),
        quats=rotations.normalize(quats[order]).astype(np.float32),
        log_scales=log_scales[order].astype(np.float32),
        opacity_logits=g["opacity_logits"][order].astype(np.float32),
        sh=sh[order].astype(np.float32),
        object_ids=object_ids[order],
        motion_ids=motion_ids[order],
        track_times=tensors["tracks.times"].numpy().astype(np.float64),
        track_poses=np.stack(track_poses),
        objects=_objects(object_ids[order], tensors["object_ids"].numpy(), dataset),
        groups=tuple(rows),
        t_max=float(tensors["tracks.times"][last]),
        frames_per_unit=dataset.frames_per_unit,
        world_convention=dataset.world_convention,
        cameras=dataset.cameras,
        background_sh=used_background.astype(np.float32),
        identities=tensors["identities"].numpy()[order].astype(np.float16) if "identities" in tensors else None,
        classifier_weight=tensors["classifier.weight"].numpy() if "classifier.weight" in tensors else None,
        classifier_bias=tensors["classifier.bias"].numpy() if "classifier.bias" in tensors else None,
        shading=shading[order].astype(np.float32) if keep_shading else None,
        light_direction=light if keep_shading else None,
        provenance={
            "config": run.config.to_dict(),
            "dataset_digest": run.digest,
            "versions": run.versions,
            "train": {
                "seconds": state["seconds"],
                "iterations": state["iteration"],
                "gaussians": len(means),
                "finished": state["finished"],
            },
        },
        needs=decisions,
        near_plane=NEAR_PLANE * norm.scale,
    )


def _groups(tensors: dict[str, Any], observed: np.ndarray, motion_ids: np.ndarray, norm: Normalization) -> list[_Group]:
    """All motion groups in the world; group 0 and every body and shadow, also those without members."""
    tracks = tracks_of(tensors)
    quats = tracks.knot_quats().detach().numpy().astype(np.float64)
    displacements = tracks.params["translations"].detach().numpy().astype(np.float64) * norm.scale
    centers = norm.points_to_world(tracks.centers.numpy())
    follow = tracks.follow_matrix().detach().numpy().astype(np.float64)
    object_ids = tensors["object_ids"].numpy()
    steps = len(tracks.times)
    still = rotations.identity(steps)
    groups = [_Group(0, "pinned", norm.origin, still, np.zeros((steps, 3)), motion_ids == 0, np.ones(steps, bool))]
    for body in range(1, tracks.bodies):
        members = motion_ids == body
        seen = observed[body - 1]
        groups.append(
            _Group(int(object_ids[body]), "body", centers[body], quats[body], displacements[body], members, seen)
        )
    for row, caster in enumerate(tracks.casters.numpy()):
        followed = displacements[caster] @ follow.T
        members = motion_ids == tracks.bodies + row
        owner = int(object_ids[caster])
        groups.append(
            _Group(owner, "shadow", centers[caster], still, followed, members, observed[caster - 1], int(caster))
        )
    return groups


def _motion_group(
    index: int,
    group: _Group,
    tensors: dict[str, Any],
    pivot: np.ndarray,
    relative: np.ndarray,
    shift: np.ndarray,
    means: np.ndarray,
    opacities: np.ndarray,
) -> MotionGroup:
    distance = np.linalg.norm(means - pivot, axis=1)
    voters = opacities > 0.3 if (opacities > 0.3).any() else np.ones(len(opacities), bool)
    anchor = int(np.argmin(np.where(voters, distance, np.inf))) if len(means) else -1
    radius = float(np.quantile(distance[voters], 0.9)) if len(means) else 1.0
    radius = max(radius, 1e-9)
    if group.role == "pinned":
        return MotionGroup(index, 0, "pinned", anchor, pivot, MotionModel(radius=radius))
    if group.role == "shadow":
        follow = tracks_of(tensors).follow_matrix().detach().numpy().astype(np.float64)
        return MotionGroup(
            index, group.object_id, "shadow", anchor, pivot, MotionModel(radius=radius), group.caster, follow
        )
    times = tensors["tracks.times"].numpy().astype(np.float64)
    fit = fitting.fit(times, relative, shift, radius=radius, weights=group.observed.astype(np.float64))
    return MotionGroup(index, group.object_id, "body", anchor, pivot, fit.model)


def _bind_shading(
    sh: np.ndarray, shading: np.ndarray, quat: np.ndarray, light: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours and shading vectors taken over to the bind state; see the module's notation."""
    change = rotations.rotate(rotations.conjugate(quat), light) - light
    factor = np.maximum(1 + shading @ change, MIN_BIND_FACTOR)
    colored = sh * factor[:, None, None]
    # The offset of one half scales too: dc_to_rgb(dc') = factor * dc_to_rgb(dc).
    colored[:, 0] = spherical_harmonics.rgb_to_dc(spherical_harmonics.dc_to_rgb(sh[:, 0]) * factor[:, None])
    return colored, rotations.rotate(quat, shading) / factor[:, None]


def _pivot(means: np.ndarray, opacities: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Middle of a group: per axis the opacity-weighted mean of members within the 5 % and 95 % quantiles."""
    if len(means) < 3:
        return np.asarray(means.mean(0) if len(means) else fallback, np.float64)
    low, high = np.quantile(means, [0.05, 0.95], axis=0)
    inner = ((means >= low) & (means <= high)).all(1)
    if not inner.any():
        return np.median(means, axis=0)
    return np.average(means[inner], axis=0, weights=opacities[inner])


def _background(coefficients: np.ndarray) -> np.ndarray:
    """The sky's coefficients, only to the degree that shows: bands below half an 8-bit level are left out."""
    degree = spherical_harmonics.degree_of(len(coefficients))
    while degree > 0 and np.abs(coefficients[degree**2 :]).max() < needs.SKY_BAND:
        degree -= 1
        coefficients = coefficients[: (degree + 1) ** 2]
    return coefficients


def _objects(object_ids: np.ndarray, present: np.ndarray, dataset: Dataset) -> tuple[SceneObject, ...]:
    """The table: unassigned Gaussians if any, the background, then every object; rows are sorted by id."""
    table = []
    ids = [-1] * bool((object_ids == -1).any()) + sorted({0, *(int(i) for i in present)})
    taken: set[str] = set()
    for object_id in ids:
        rows = np.flatnonzero(object_ids == object_id)
        start = int(rows[0]) if len(rows) else int(np.searchsorted(object_ids, object_id))
        default = {-1: "unassigned", 0: "background"}.get(object_id, f"object {object_id}")
        name = dataset.object_names.get(object_id, default)
        if name in taken:
            name = f"{name} {object_id}"
        taken.add(name)
        hue = object_id * 0.6180339887 % 1.0
        color = (0.5, 0.5, 0.5) if object_id <= 0 else colorsys.hls_to_rgb(hue, 0.55, 0.65 if object_id % 2 else 0.9)
        aliases = tuple(dataset.object_aliases.get(object_id, ()))
        table.append(SceneObject(object_id, name, aliases, "", color, start, len(rows)))
    return tuple(table)


def run_bake(folder: Path, out: Path, dataset_root: Path | None = None) -> Scene:
    """Bake a run folder and write the scene file; returns the scene."""
    from ..scene import scene_file

    run = checkpoint.open_run(folder)
    dataset = datasets.read(dataset_root if dataset_root is not None else run.dataset_root)
    scene = bake(run, dataset)
    scene_file.write(scene, out)
    return scene

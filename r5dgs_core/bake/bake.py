"""Bake a checkpoint into a scene: bind state at t_max, tracks in world coordinates, and a motion model per group.

Notation: in training a body moves x -> c + R_s (x - c) + d_s. With the bind state at the last knot T and any pivot p,
the same motion is x_bind -> p + Q_s (x_bind - p) + D_s with Q_s = R_s R_T^-1 and D_s = c + d_s + Q_s (p - c - d_T) - p.
Colours are transferred to the bind state by `train.representations.shading`.
"""

from __future__ import annotations

import colorsys
import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..config import config as configs
from ..config.config import Config
from ..config.sections import NeedsSection
from ..data import dataset as datasets
from ..data.dataset import Dataset
from ..errors import CheckpointError, DatasetError
from ..motion import rotations
from ..motion.models import MotionModel
from ..playback import residuals, visibility
from ..scene import scene_file, sh_color
from ..scene.scene import NEAR_PLANE, Gaussians, MotionGroup, Scene, SceneObject, Shading, Tracks
from ..train import checkpoint, checkpoint_content, observed_motion, probe, train_views
from ..train.identity import label_cleanup, packed_masks
from ..train.normalization import Normalization
from ..train.representations import registry, representation
from ..train.representations import shading as shading_vectors
from . import image_evidence, needs, point_motion, simplify_motion, track_checks

log = logging.getLogger(__name__)


def bake(run: checkpoint.Run, dataset: Dataset | None = None) -> Scene:
    """Bake the last checkpoint of a run into a scene.

    Args:
        run: A run folder; its training may be unfinished.
        dataset: The data set; read from the place recorded in the run if None.

    Returns:
        The scene, in the world coordinates of the data set.

    Raises:
        CheckpointError, DatasetError: A file is missing or damaged.
    """
    dataset = (
        dataset
        if dataset is not None
        else datasets.read(run.data(), run.config.data.masks, run.config.data.min_registered)
    )
    state = checkpoint.load(run.folder)
    tensors, wanted = state.tensors, run.config.needs
    # Discovered objects have no names; their ids are not those of the data set.
    found = packed_masks.NAME in tensors or packed_masks.LABELS in tensors
    if found:
        dataset = dataclasses.replace(dataset, object_names={}, object_aliases={})
    norm = Normalization(np.array(state.origin) - dataset.origin, state.scale)
    cloud, motion = _observed(run, state, norm)
    light, strength = _unit(motion.light)
    cloud.shading *= strength
    names = {int(i): dataset.object_names.get(int(i), f"object {i}") for i in tensors["object_ids"]}
    bound = _bind(cloud, motion, norm, light, wanted, names)
    rows = bound.rows
    order = np.lexsort((cloud.motion_ids, cloud.object_ids))
    used_background = _background(tensors["background"].numpy(), wanted.sky_gradient)
    bends, own = None, None
    if motion.points is not None and wanted.tracks != "off":
        extent = float(np.ptp(np.quantile(cloud.means, [0.01, 0.99], axis=0), axis=0).max())
        # Relative to the trained poses, so that motion that the user switched off does not return as residuals.
        bends, own = point_motion.members(
            motion.points, norm, cloud.motion_ids, bound.trained, bound.pivots, order, extent
        )
    bent = (0.0, 0.0, False, "nothing moves")
    if state.representation != representation.STILL:
        from ..train.representations import residual

        bent = residual.need(tensors, dataset.object_names, run.config, bends is not None)
    if not bent[2] or wanted.residuals == "off":
        bends = None
    elif bends is not None:
        rows = point_motion.departures(rows, cloud.motion_ids[order], bends)
    shaded = bool(run.config.train.shading) and wanted.shading != "off"
    rank = np.argsort(order)
    rows = [
        dataclasses.replace(row, anchor_index=int(rank[row.anchor_index])) if row.anchor_index >= 0 else row
        for row in rows
    ]
    scene = Scene(
        name=dataset.name,
        gaussians=Gaussians(
            means=cloud.means[order].astype(np.float32),
            quats=rotations.normalize(cloud.quats[order]).astype(np.float32),
            log_scales=cloud.log_scales[order].astype(np.float32),
            opacity_logits=cloud.opacity_logits[order].astype(np.float32),
            sh=cloud.sh[order].astype(np.float32),
            object_ids=cloud.object_ids[order],
            motion_ids=cloud.motion_ids[order],
        ),
        objects=_objects(cloud.object_ids[order], tensors["object_ids"].numpy(), dataset),
        groups=tuple(rows),
        tracks=Tracks(times=motion.times.astype(np.float64), poses=bound.played),
        t_max=float(motion.times[-1]),
        frames_per_unit=dataset.frames_per_unit,
        world_convention=dataset.world_convention,
        cameras=dataset.cameras,
        background_sh=used_background.astype(np.float32),
        shading=_shading(cloud, order, light) if shaded else None,
        provenance={
            "config": run.config.to_dict(),
            "dataset_digest": run.digest,
            "versions": run.versions,
            "discovered": found,
            "train": {
                "seconds": state.seconds,
                "iterations": state.iteration,
                "gaussians": len(cloud.means),
                "finished": state.finished,
            },
        },
        near_plane=NEAR_PLANE * norm.scale,
        origin=dataset.origin,
        residuals=bends,
        dynamics=own,
    )
    observed = np.stack([group.observed for group in motion.groups])
    trained = scene
    simplified = simplify_motion.simplify(scene, observed, _evidence(scene, dataset, run.config), wanted)
    scene = simplified.scene
    decisions = needs.decide(
        scene.groups,
        scene.tracks.poses,
        cloud.motion_ids,
        cloud.shading,
        light,
        used_background,
        cloud.sh.shape[1],
        cloud.identities is not None,
        wanted,
        bent,
        motion.moves,
    )
    scene = dataclasses.replace(scene, needs=(*decisions, *simplified.rows))
    if not needs.is_on(decisions, "shading"):
        scene = dataclasses.replace(scene, shading=None)
    if cloud.identities is not None and needs.is_on(decisions, "classifier"):
        scene = scene.with_arrays(
            identities=cloud.identities[order].astype(np.float16),
            classifier_weight=tensors["classifier.weight"].numpy(),
            classifier_bias=tensors["classifier.bias"].numpy(),
        )
    compared = _on_training_views(tensors, trained, scene, dataset, run.config)
    scene = dataclasses.replace(scene, provenance=scene.provenance | compared)
    cleaned = label_cleanup.changes_of(tensors)
    if cleaned is not None:
        scene = dataclasses.replace(scene, provenance=scene.provenance | {"label_hygiene": cleaned})
    if motion.moves is None:
        return scene
    counts = dataclasses.asdict(motion.moves) | {"unexplained": len(residuals.unexplained(scene))}
    return dataclasses.replace(scene, provenance=scene.provenance | {"regrouping": counts})


def _shading(cloud: _Cloud, order: np.ndarray, light: np.ndarray) -> Shading:
    rest = cloud.rest[order].astype(np.float32) if (cloud.rest != 1).any() else None
    return Shading(cloud.shading[order].astype(np.float32), light, rest)


def _evidence(scene: Scene, dataset: Dataset, config: Config) -> image_evidence.ImageEvidence | None:
    """Return the evidence of the training images on a scene's motion; None if nothing moves or an image is missing.

    A missing image is logged as a warning.
    """
    if not np.any(scene.tracks.poses[..., 1:] != 0):
        return None
    sampled = image_evidence.sample(dataset.train)
    try:
        return image_evidence.ImageEvidence(scene, sampled, train_views.behind(dataset, config))
    except DatasetError as error:
        log.warning(
            "the motion is simplified without the training images, so only motion below fixed thresholds is dropped: "
            "%s. Remedy: give the data set with --data",
            error,
        )
        return None


def _on_training_views(
    tensors: dict[str, Tensor], trained: Scene, scene: Scene, dataset: Dataset, config: Config
) -> dict[str, Any]:
    """Return the PSNR of the checkpoint and of the scene on the training views, for the provenance.

    A checkpoint of an unfinished or older run does not store its PSNR; the scene with the trained motion is measured
    instead. The result is empty if an image is missing.
    """
    behind = train_views.behind(dataset, config)
    try:
        baked = probe.training_psnr(dataset, behind, image_evidence.painter(scene))
        if checkpoint_content.TRAIN_PSNR in tensors:
            before = float(tensors[checkpoint_content.TRAIN_PSNR])
        else:
            before = probe.training_psnr(dataset, behind, image_evidence.painter(trained))
    except DatasetError:  # `_evidence` has logged it
        return {}
    return {"training_views": {"checkpoint_psnr": before, "baked_psnr": baked}}


@dataclass
class _Cloud:
    """Gaussians of a run in world coordinates, in the order of training. `_bind` brings them to the bind state.

    Attributes:
        means: [N, 3] float64
        quats: Unit wxyz. [N, 4] float64
        log_scales: [N, 3]
        opacity_logits: [N]
        sh: [N, K, 3] float64
        shading: [N, 3] float64
        rest: Factor of the colour at rest. [N] float64
        motion_ids: [N] int32
        object_ids: [N] int32
        identities: [N, 16] or None
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    shading: np.ndarray
    rest: np.ndarray
    motion_ids: np.ndarray
    object_ids: np.ndarray
    identities: np.ndarray | None


@dataclass(frozen=True)
class _Bound:
    """Motion groups after `_bind`.

    Attributes:
        rows: The scene's groups, with static models.
        trained: Trained poses relative to the bind state. [G, S, 7]
        pivots: Pivots of these poses. [G, 3]
        played: The same poses without the parts that the user switched off. [G, S, 7]
    """

    rows: list[MotionGroup]
    trained: np.ndarray
    pivots: np.ndarray
    played: np.ndarray


def _observed(
    run: checkpoint.Run, state: checkpoint.Checkpoint, norm: Normalization
) -> tuple[_Cloud, observed_motion.ObservedMotion]:
    """Return the Gaussians and the observed motion of a checkpoint, without what the user switched off."""
    tensors, wanted = state.tensors, run.config.needs
    g = {n.removeprefix("gaussians."): t.numpy() for n, t in tensors.items() if n.startswith("gaussians.")}
    if not all(np.isfinite(a).all() for a in g.values()):
        raise CheckpointError(f"{run.folder}: the checkpoint holds values that are not finite; train again")
    present = tensors["object_ids"].numpy()
    if "labels" in tensors:
        labels = tensors["labels"].numpy()
    else:  # an unfinished run has no labels yet
        labels = registry.group_classes(state.representation, tensors)[g["motion_ids"]]
    motion = registry.observed_motion(
        state.representation, tensors, present, state.observed.numpy(), labels, run.config
    )
    g |= motion.gaussians or {}
    if motion.motion_ids is not None:
        g["motion_ids"] = motion.motion_ids
    identities = tensors["identities"].numpy() if "identities" in tensors else None
    if wanted.shadows == "off":
        kept_groups = tuple(group for group in motion.groups if group.role != "shadow")
        kept = g["motion_ids"] < len(kept_groups)  # shadows are the last groups
        g = {n: a[kept] for n, a in g.items()}
        identities, labels = None if identities is None else identities[kept], labels[kept]
        points = None if motion.points is None else motion.points.keep(kept)
        motion = dataclasses.replace(motion, groups=kept_groups, points=points)
    sh = np.concatenate([g["sh"], g["sh_rest"]], axis=1).astype(np.float64)
    cloud = _Cloud(
        means=norm.points_to_world(g["means"]),
        quats=rotations.normalize(g["quats"].astype(np.float64)),
        log_scales=g["log_scales"] + np.log(norm.scale),
        opacity_logits=g["opacity_logits"],
        sh=sh[:, :1] if wanted.view_dependent_colour == "off" else sh,
        shading=g["shading"].astype(np.float64),
        rest=g.get("shading_rest", np.ones(len(g["means"]))).astype(np.float64),
        motion_ids=g["motion_ids"].astype(np.int32),
        object_ids=present[labels].astype(np.int32),
        identities=identities,
    )
    return cloud, motion


def _bind(
    cloud: _Cloud,
    motion: observed_motion.ObservedMotion,
    norm: Normalization,
    light: np.ndarray,
    wanted: NeedsSection,
    names: dict[int, str],
) -> _Bound:
    """Bring the Gaussians to the bind state, in place, and return their motion groups."""
    rows, trained, pivots, played = [], [], [], []
    opacities = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    for index, group in enumerate(motion.groups):
        group = track_checks.sound(group, names.get(group.object_id, "background"))
        members = cloud.motion_ids == index
        center = norm.points_to_world(group.center)
        path = group.displacements * norm.scale
        q, d = group.quats[-1], path[-1]
        cloud.means[members] = center + rotations.rotate(q, cloud.means[members] - center) + d
        cloud.quats[members] = rotations.multiply(q, cloud.quats[members])
        turned = sh_color.rotate(cloud.sh[members], q)
        cloud.sh[members], cloud.shading[members], cloud.rest[members] = shading_vectors.rebind(
            turned, cloud.shading[members], cloud.rest[members], q, light
        )
        pivot = _pivot(cloud.means[members], opacities[members], center + d)
        poses = _relative(group.quats, path, center, pivot)
        if group.observed.any() and not motion.smooth:  # before an object is seen its pose is unknown
            first = int(np.argmax(group.observed))
            poses[:first] = poses[first]
        trained.append(poses.copy())
        pivots.append(pivot)
        radius = max(_radius(cloud.means[members], opacities[members], pivot), 1e-9 * norm.scale)
        if wanted.rotation == "off":
            poses[:, :4] = needs.STILL_QUAT
        if group.role == "pinned" or wanted.tracks == "off":
            poses[:] = [1.0, 0, 0, 0, 0, 0, 0]
        played.append(poses)
        anchor = _anchor(np.flatnonzero(members), cloud.means[members], opacities[members], pivot)
        rows.append(_motion_group(index, group, motion.times, pivot, MotionModel(radius=radius), anchor))
    return _Bound(rows, np.stack(trained), np.stack(pivots), np.stack(played))


def _relative(quats: np.ndarray, path: np.ndarray, center: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Return poses about the pivot relative to the bind state, exactly the identity at the last knot. [S, 7]

    Args:
        quats: Rotations about ``center``, wxyz. [S, 4]
        path: Displacements of ``center``, world. [S, 3]
        center: The canonical centre, world. [3]
        pivot: The pivot in the bind state, world. [3]
    """
    relative = rotations.multiply(quats, rotations.conjugate(quats[-1]))
    relative = rotations.make_continuous(rotations.normalize(relative))
    shift = center + path + rotations.rotate(relative, pivot - center - path[-1]) - pivot
    relative[-1], shift[-1] = [1.0, 0, 0, 0], 0.0
    return np.concatenate([relative, shift], axis=1)


def _radius(means: np.ndarray, opacities: np.ndarray, pivot: np.ndarray) -> float:
    """Return the 90 % quantile of the visible members' distances from the pivot; 1 without members."""
    if len(means) == 0:
        return 1.0
    return float(np.quantile(np.linalg.norm(means - pivot, axis=1)[visibility.seen(opacities)], 0.9))


def _anchor(rows: np.ndarray, means: np.ndarray, opacities: np.ndarray, pivot: np.ndarray) -> int:
    """Return the row of the visible member nearest to the pivot, -1 without members."""
    if len(rows) == 0:
        return -1
    distance = np.where(visibility.seen(opacities), np.linalg.norm(means - pivot, axis=1), np.inf)
    return int(rows[np.argmin(distance)])


def _motion_group(
    index: int,
    group: observed_motion.GroupTrack,
    times: np.ndarray,
    pivot: np.ndarray,
    model: MotionModel,
    anchor: int,
) -> MotionGroup:
    """Return the scene's `MotionGroup` of a track whose members all move rigidly with it."""
    seen = times[group.observed]
    return MotionGroup(
        index,
        group.object_id,
        group.role,
        anchor,
        pivot,
        model,
        group.follows,
        group.follow_matrix,
        seen=(float(seen[0]), float(seen[-1])) if len(seen) else None,
    )


def _unit(vector: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the direction and the length of a vector; the direction is z if the length is zero."""
    length = float(np.linalg.norm(vector))
    return (vector / length, length) if length > 1e-12 else (np.array([0.0, 0, 1]), 0.0)


def _pivot(means: np.ndarray, opacities: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Return the centre of a group: opacity-weighted mean per axis, without the outer 5 % at both ends."""
    if len(means) < 3:
        return np.asarray(means.mean(0) if len(means) else fallback, np.float64)
    low, high = np.quantile(means, [0.05, 0.95], axis=0)
    inner = ((means >= low) & (means <= high)).all(1)
    if not inner.any():
        return np.median(means, axis=0)
    return np.average(means[inner], axis=0, weights=opacities[inner])


def _background(coefficients: np.ndarray, wanted: str) -> np.ndarray:
    """Return the sky's coefficients without the highest degrees that an 8-bit image does not show (below half a level).

    Args:
        coefficients: Trained coefficients. [Kb, 3]
        wanted: User's override for the gradient: "on" keeps all degrees, "off" only the constant, "auto" measures.
    """
    if wanted != "auto":
        return coefficients if wanted == "on" else coefficients[:1]
    degree = sh_color.degree_of(len(coefficients))
    while degree > 0 and np.abs(coefficients[degree**2 :]).max() < needs.SKY_BAND:
        degree -= 1
        coefficients = coefficients[: (degree + 1) ** 2]
    return coefficients


def _objects(object_ids: np.ndarray, present: np.ndarray, dataset: Dataset) -> tuple[SceneObject, ...]:
    """Return the object table, sorted by id: unassigned Gaussians (if any), background, objects."""
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


def run_bake(folder: Path, out: Path, dataset_root: Path | None = None, overrides: Sequence[str] = ()) -> Scene:
    """Bake a run folder, write the scene file and return the scene.

    Args:
        folder: The run folder.
        out: Path of the scene file.
        dataset_root: The data set; None if it has not moved since training.
        overrides: ``needs.NAME=on|off`` overrides of the run's configuration.

    Raises:
        CheckpointError: The checkpoint is missing or damaged, or the data set is not the one of the training.
        ConfigError, UsageError: An override is invalid.
        DatasetError, SceneFileError: The data set cannot be read, or the scene file cannot be written.
    """
    run = checkpoint.open_run(folder)
    configs.require_needs(overrides)
    run = dataclasses.replace(run, config=run.config.override(overrides))
    dataset = datasets.read(run.data(dataset_root), run.config.data.masks, run.config.data.min_registered)
    if dataset.digest != run.digest:
        raise CheckpointError(
            f"{dataset.root}: is not the data that {folder} was trained on, or has changed since; "
            "name that data with --data, or train again"
        )
    scene = bake(run, dataset)
    scene_file.write(scene, out)
    return scene

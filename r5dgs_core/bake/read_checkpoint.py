"""First stage of baking: the Gaussians and the observed motion of a checkpoint."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..data import dataset as datasets
from ..data.dataset import Dataset
from ..errors import CheckpointError
from ..motion import rotations
from ..train import checkpoint, run_folder
from ..train.normalization import Normalization
from ..train.refinement import refined_dataset
from ..train.representations import registry
from .draft import Cloud, Context, ObservedScene, is_discovered


def open_context(run: run_folder.Run, dataset: Dataset | None) -> Context:
    """Load the last checkpoint of a run, and the data set if None is given.

    Raises:
        CheckpointError, DatasetError: A file is missing or damaged.
    """
    if dataset is None:
        dataset = datasets.read(run.data(), run.config.data.masks, run.config.data.min_registered)
    state = checkpoint.load(run.folder)
    if is_discovered(state):
        dataset = dataclasses.replace(dataset, object_names={}, object_aliases={})
    norm = Normalization(np.array(state.origin) - dataset.origin, state.scale)
    refined = refined_dataset.apply(dataset, refined_dataset.corrections(dataset, state.tensors, norm))
    return Context(run, state, refined, norm, dataset)


def observe(context: Context) -> ObservedScene:
    """Return the Gaussians and the observed motion of a checkpoint, without the features that the user disabled."""
    tensors, wanted, norm = context.tensors, context.wanted, context.norm
    state, config = context.state, context.config
    g = {n.removeprefix("gaussians."): t.numpy() for n, t in tensors.items() if n.startswith("gaussians.")}
    if not all(np.isfinite(a).all() for a in g.values()):
        raise CheckpointError(f"{context.run.folder}: the checkpoint holds values that are not finite; train again")
    present = tensors["object_ids"].numpy()
    representation = registry.by_name(state.representation)
    if "labels" in tensors:
        labels = tensors["labels"].numpy()
    else:  # an unfinished run has no labels yet
        labels = representation.group_classes(tensors)[g["motion_ids"]]
    motion = representation.observed_motion(tensors, present, state.observed.numpy(), labels, config)
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
    direction, strength = _unit(motion.light)
    cloud = Cloud(
        means=norm.points_to_world(g["means"]),
        quats=rotations.normalize(g["quats"].astype(np.float64)),
        log_scales=g["log_scales"] + np.log(norm.scale),
        opacity_logits=g["opacity_logits"],
        sh=sh[:, :1] if wanted.view_dependent_colour == "off" else sh,
        shading=g["shading"].astype(np.float64) * strength,
        rest=g.get("shading_rest", np.ones(len(g["means"]))).astype(np.float64),
        motion_ids=g["motion_ids"].astype(np.int32),
        object_ids=present[labels].astype(np.int32),
        identities=identities,
    )
    return ObservedScene(cloud, motion, direction)


def _unit(vector: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the direction and the length of a vector; the direction is z if the length is zero."""
    length = float(np.linalg.norm(vector))
    return (vector / length, length) if length > 1e-12 else (np.array([0.0, 0, 1]), 0.0)

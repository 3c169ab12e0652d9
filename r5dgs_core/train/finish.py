"""End of a run: labels and identity encodings on the final geometry."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ..config import training_needs
from ..data.dataset import Dataset, View
from ..scene.splats import to_opacities
from . import checkpoint_content, view_psnr
from .identity import identity_training, label_cleanup, label_votes
from .refinement import refined_dataset
from .representations.fused_posing import PosedSplats
from .train_views import TrainView
from .trainer import Trainer

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]


def identity_steps(trainer: Trainer) -> int:
    """Return the number of steps for identity encodings after the run; each costs about as much as a training step."""
    if trainer.config.identity.training != "after":
        return 0
    masked = any(view.has_mask for view in trainer.given_views)
    return trainer.config.identity.iterations if masked and len(trainer.object_ids) > 1 else 0


def final_tensors(trainer: Trainer, progress: Progress) -> dict[str, torch.Tensor]:
    """Return labels, identity encodings and the training views' PSNR on the final geometry, by checkpoint names."""
    classes = {int(i): row for row, i in enumerate(trainer.object_ids)}
    group_classes = trainer.motion.group_classes(trainer.motion.tensors())
    device = trainer.gaussians.motion_ids.device
    fallback = torch.from_numpy(group_classes)[trainer.gaussians.motion_ids.cpu()]
    extra: dict[str, torch.Tensor] = {"labels": fallback}
    if any(v.has_mask for v in trainer.given_views):

        @torch.no_grad()
        def pose(view: TrainView) -> PosedSplats:
            return trainer.splats(view.camera, view.t)

        progress({"event": "prepare", "text": "labels, by a vote of the masks"})
        votes = label_votes.votes(trainer.views, pose, classes, len(fallback))
        extra["labels"] = label_votes.elect(votes, fallback)
        steps = identity_steps(trainer)
        if trainer.identity is not None:
            extra |= trainer.identity.outcome(trainer.gaussians)
        elif steps > 0:

            def report(step: int, loss: torch.Tensor) -> None:
                if step % trainer.config.train.log_every == 0 or step == steps:
                    progress({"event": "identity", "iteration": step, "iterations": steps, "loss": float(loss)})

            # A separate generator, so that a run resumed here draws the same numbers.
            draws = torch.Generator().manual_seed(trainer.config.train.seed + 1)
            encodings, weight, bias = identity_training.train_encodings(
                trainer.views,
                pose,
                classes,
                extra["labels"].to(device),
                trainer.config,
                trainer.gaussians.means.detach(),
                draws,
                report,
            )
            extra |= {"identities": encodings, "classifier.weight": weight, "classifier.bias": bias}
        if trainer.config.identity.hygiene and len(classes) > 1:
            # Labels are cleaned after the encodings are trained: encodings follow the edges of the masks, but cleaned
            # labels also follow motion.
            extra |= _cleaned(trainer, votes, extra["labels"])
    elif trainer.motion.sorts_by_motion and training_needs.sorting(trainer.dataset, trainer.config):
        from . import object_discovery

        progress({"event": "prepare", "text": "no masks: sorting moving Gaussians into parts"})
        labels = torch.from_numpy(object_discovery.sort_into_parts(trainer) + 1)
        count = int(labels.max())
        progress({"event": "prepare", "text": f"no masks: {count} moving part{'s' * (count != 1)} found"})
        extra |= {"labels": labels, "object_ids": torch.arange(count + 1), checkpoint_content.DISCOVERED_LABELS: labels}
    with torch.no_grad():
        shown = view_psnr.training_psnr(
            _refined(trainer),
            trainer.behind,
            lambda view: trainer.render(trainer.normalization.camera(view.camera), view.t).cpu().numpy(),
            _explained(trainer),
        )
    extra[checkpoint_content.TRAIN_PSNR] = torch.tensor(shown, dtype=torch.float64)
    return {name: tensor.cpu() for name, tensor in extra.items()}


def _refined(trainer: Trainer) -> Dataset:
    """Return the data set with the corrections of the run's cameras."""
    tensors = trainer.refinement.tensors()
    found = refined_dataset.corrections(trainer.dataset, tensors, trainer.normalization)
    return refined_dataset.apply(trainer.dataset, found)


def _explained(trainer: Trainer) -> Callable[[View, np.ndarray], np.ndarray | None]:
    """Return a function that returns the pixels of a view that the run has not left out; None for all. [H, W] bool"""
    given = {view.name: view for view in trainer.given_views}

    def pixels(view: View, image: np.ndarray) -> np.ndarray | None:
        left_out = given[view.name].unexplained
        return None if left_out is None else ~left_out

    return pixels


def _cleaned(trainer: Trainer, votes: torch.Tensor, labels: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the cleaned labels and the counts of changes, by their names in the checkpoint."""
    given, tensors = labels.numpy(), trainer.state().tensors
    params = {name: tensors[f"gaussians.{name}"] for name in trainer.gaussians.params}
    ids = tensors["gaussians.motion_ids"]
    motion = trainer.motion.observed_motion(
        tensors,
        trainer.object_ids,
        trainer.places.shown,
        given,
        trainer.config,
    )
    gaussians = {name: tensor.numpy() for name, tensor in params.items()} | (motion.gaussians or {})
    group_ids = ids.numpy() if motion.motion_ids is None else motion.motion_ids
    points = label_cleanup.bind_positions(motion.groups, group_ids, gaussians["means"])
    companions, moving_classes = label_cleanup.find_companions(motion.groups, group_ids, points, trainer.object_ids)
    opacities = to_opacities(gaussians["opacity_logits"])
    found, changes = label_cleanup.clean(votes.numpy(), given, points, opacities, companions, moving_classes)
    counts = dataclasses.astuple(changes)
    log.info("labels: %d by neighbours, %d by motion, %d outliers changed of %d", *counts)
    return {"labels": torch.from_numpy(found), label_cleanup.CHANGES: torch.tensor(counts)}

"""Discovery of objects without masks: a short run of a field, whose rigidly moving parts become the objects.

The moving Gaussians of the field are segmented into rigidly moving parts (`motion_clusters.py`), and the rendering of a
part in a view is its mask. A run of tracks then starts from these masks, and uses them only for its initialisation.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from ..config import training_needs
from ..config.config import Config
from ..data.dataset import Dataset
from ..motion import rotations
from ..raster import rasterize_splats
from ..raster.arrays import to_host
from ..scene import visibility
from ..scene.sampling import spread
from . import motion_clusters, train_views
from .identity import packed_masks
from .representations import gating
from .representations.field import FieldRepresentation
from .representations.fused_posing import PosedSplats
from .train_views import TrainView
from .trainer import Trainer

log = logging.getLogger(__name__)

MAX_VIEWS = 20  # maximum number of views in which the need for a part is measured
MIN_GAIN_DB = 2.0  # minimum gain in PSNR by the motion of a part, dB
MAX_MISFIT = 0.02  # maximum residual of points that hardly move, normalised units
MIN_PIECE_SIZE = 0.1  # minimum size of a piece of a mask, relative to its largest piece
MAX_GAUSSIANS = 12000  # maximum number of Gaussians in the short run


def find_masks(
    dataset: Dataset, config: Config, progress: Callable[[dict[str, Any]], None] | None = None
) -> Sequence[np.ndarray] | None:
    """Find masks of the moving objects in the training views.

    Args:
        dataset: The data set.
        config: Configuration of the run that the masks are for.
        progress: Called with events at the start, during the run and at the end.

    Returns:
        Ids per pixel, 0 for the background [H, W], for each training view. None if discovery does not apply
        (`training_needs.discovery`) or nothing moves.

    Raises:
        DatasetError, TrainingError: As from a training run.
    """
    if not training_needs.discovery(dataset, config):
        return None
    progress = progress or (lambda event: None)
    progress({"event": "prepare", "text": "no masks: looking for moving objects"})
    trainer = Trainer(dataset, _short(config, max(view.t for view in dataset.train)))
    if not trainer.motion.moves:
        train_views.forget(trainer.given_views)
        return None
    while not trainer.done:
        trainer.step()
        if trainer.iteration % config.train.log_every == 0 or trainer.done:
            total = trainer.config.train.iterations
            progress({"event": packed_masks.PHASE, "done": trainer.iteration, "total": total, "unit": "steps"})
    labels = find_parts(trainer, config)
    count = int(labels.max(initial=-1)) + 1
    progress({"event": "prepare", "text": f"no masks: {count} moving part{'s' * (count != 1)} found"})
    masks = draw_masks(trainer, labels) if count > 0 else None
    train_views.forget(trainer.given_views)  # the run that follows reads them into a cache of its own
    return masks


def _short(config: Config, last: float) -> Config:
    """Return the configuration of the short run: a small field of few Gaussians, without features for image quality.

    Args:
        config: Configuration of the run that the masks are for.
        last: The last observed time, used as the field's horizon.
    """
    cap = config.densify.max_gaussians
    return config.replace(
        **{
            "train.representation": "field",
            "train.iterations": config.discovery.iterations,
            "train.sh_degree": 0,
            "train.shading": False,
            "train.shadows": False,
            "init.placement": "scene",
            "densify.strategy": "share",
            "densify.max_gaussians": min(cap, MAX_GAUSSIANS) if cap else 0,
            "field.size": "small",
            "field.width": 0,
            "field.horizon": max(round(last, 9), 0.0),
            "field.trd_share": 0.0,
            "field.trd_steps": 0,
            "field.place_steps": 0,
            "field.tracks_share": 0.0,
            "field.movers": "measured",
            "field.gate": config.discovery.gate,
            "field.still": config.discovery.still,
            "identity.training": "off",
        }
        | {f"needs.{f.name}": "auto" for f in dataclasses.fields(config.needs)}
    )


def find_parts(trainer: Trainer, config: Config) -> np.ndarray:
    """Return the rigidly moving part of each opaque Gaussian of a field, -1 for none. [N]"""
    rows, opacities = _movers(trainer)
    rows, opacities = rows[opacities > visibility.SEEN_OPACITY], opacities[opacities > visibility.SEEN_OPACITY]
    return _labelled(trainer, config, rows, opacities, _paths(trainer, rows))


def sort_into_parts(trainer: Trainer) -> np.ndarray:
    """Return the rigidly moving part of each Gaussian of a trained field, -1 for none. [N]

    Faint Gaussians, which `find_parts` excludes, join the part that they move with.

    Args:
        trainer: A finished run of a field.
    """
    rows, opacities = _movers(trainer)
    paths, opaque = _paths(trainer, rows), opacities > visibility.SEEN_OPACITY
    labels = _labelled(trainer, trainer.config, rows[opaque], opacities[opaque], paths[opaque])
    labels[rows] = motion_clusters.attach(paths, opacities, MAX_MISFIT, labels[rows])
    return labels


def _labelled(
    trainer: Trainer, config: Config, rows: np.ndarray, opacities: np.ndarray, paths: np.ndarray
) -> np.ndarray:
    """Return the part of each Gaussian from the paths of ``rows``; -1 for other Gaussians and for none. [N]"""
    rng = np.random.default_rng(config.train.seed)
    labels = np.full(len(trainer.gaussians), -1)
    labels[rows] = motion_clusters.find(paths, opacities, MAX_MISFIT, config.discovery.fewest, rng)
    return without_unneeded_parts(trainer, labels)


@torch.no_grad()
def _movers(trainer: Trainer) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of Gaussians that a field moves, and their opacities. [R], [R]"""
    motion, gaussians = trainer.motion, trainer.gaussians
    assert isinstance(motion, FieldRepresentation)
    rows = motion.movers(gaussians)
    return to_host(rows), to_host(torch.sigmoid(gaussians.opacity_logits[rows]).double())


@torch.no_grad()
def _paths(trainer: Trainer, rows: np.ndarray) -> np.ndarray:
    """Return the positions of a field's Gaussians at the observed times. [R, S, 3]"""
    motion = trainer.motion
    assert isinstance(motion, FieldRepresentation)
    means = trainer.gaussians.means[torch.from_numpy(rows).to(trainer.gaussians.means.device)]
    paths = torch.stack([means + motion.motion.deltas(means, float(t)).offsets for t in trainer.times], 1)
    return to_host(paths.double())


@torch.no_grad()
def without_unneeded_parts(trainer: Trainer, labels: np.ndarray) -> np.ndarray:
    """Remove parts whose motion the images do not need: fields also move uniform regions. [N]

    Each part is rendered in motion and in its mean state. A part is kept if its motion lowers the error by more than
    `MIN_GAIN_DB` dB over the pixels that show it in at least one of the two renderings.
    """
    count = int(labels.max(initial=-1)) + 1
    errors, parts_of = np.zeros((2, count)), torch.from_numpy(labels).to(trainer.gaussians.motion_ids)
    motion, gaussians = trainer.motion, trainer.gaussians
    assert isinstance(motion, FieldRepresentation)
    mean = gating.mean_state(motion.motion, gaussians.means, gaussians.log_scales, trainer.times)
    means, scales = gaussians.means + mean.offsets, (gaussians.log_scales + mean.log_scales).exp()
    quats = rotations.multiply(mean.quats, gaussians.quats)
    for view in spread(trainer.views, MAX_VIEWS):
        moving = trainer.splats(view.camera, view.t)
        error, ids = _drawn(trainer, view, moving, parts_of)
        for k in range(count):
            rests = (parts_of == k)[:, None]
            resting = dataclasses.replace(
                moving,
                means=torch.where(rests, means, moving.means),
                quats=torch.where(rests, quats, moving.quats),
                scales=torch.where(rests, scales, moving.scales),
            )
            error_at_rest, ids_at_rest = _drawn(trainer, view, resting, parts_of)
            region = (ids == k) | (ids_at_rest == k)
            errors[:, k] += float(error[region].sum()), float(error_at_rest[region].sum())
    gains = 10 * np.log10(np.maximum(errors[1], 1e-12) / np.maximum(errors[0], 1e-12))
    log.info("parts: %s dB by moving", np.round(gains, 1))
    kept = gains > MIN_GAIN_DB
    ranks = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    return ranks[labels]


def _drawn(trainer: Trainer, view: TrainView, splats: PosedSplats, parts_of: Tensor) -> tuple[Tensor, Tensor]:
    """Return the squared error of a view's pixels, and the part that each of them shows. [H, W], [H, W]"""
    shown = rasterize_splats(
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        splats.colors,
        view.camera,
        trainer.background.image(view.camera),
        labels=parts_of,
    )
    assert shown.ids is not None
    truth = torch.from_numpy(view.image).to(splats.means.device).float() / 255
    return (shown.image - truth).square().mean(-1), shown.ids


@torch.no_grad()
def draw_masks(trainer: Trainer, labels: np.ndarray) -> packed_masks.CompressedMasks:
    """Render the masks of the training views: k + 1 for part k, 0 for the background. [H, W]"""
    kind = np.uint8 if labels.max() < 255 else np.uint16
    result, parts_of = packed_masks.CompressedMasks(), torch.from_numpy(labels).to(trainer.gaussians.motion_ids)
    for view in train_views.in_turn(trainer.views, train_views.IMAGE):
        _, ids = _drawn(trainer, view, trainer.splats(view.camera, view.t), parts_of)
        result.append(_without_specks((to_host(ids) + 1).clip(min=0).astype(kind)))
    return result


def _without_specks(mask: np.ndarray) -> np.ndarray:
    """Remove pieces of an object's mask that are much smaller than its largest piece. [H, W]"""
    kept = np.zeros_like(mask)
    for k in range(1, int(mask.max()) + 1):
        pieces = np.zeros(mask.shape, np.int32)
        ndimage.label(mask == k, output=pieces)
        sizes = np.bincount(pieces.ravel())
        good = sizes >= MIN_PIECE_SIZE * sizes[1:].max(initial=0)
        good[0] = False
        kept[good[pieces]] = k
    return kept

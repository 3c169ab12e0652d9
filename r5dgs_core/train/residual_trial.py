"""Trial of residual motion: non-rigid bodies are found by training all bodies with residuals for a short time.

Once all times have entered and the tracks have settled, training continues for some steps with a residual field on all
bodies. Then the residuals of each body are left out in turn, and the increase of the error on that body is measured on
views that these steps did not use. The run then returns to its state before the trial, and only bodies with an increase
above a threshold keep their residuals, or are divided into rigid parts if these explain the views as well
(`part_trial`). Balls whose images one turning texture explains stay rigid (`ball_repair`). If no body keeps residuals,
the run continues exactly as without a trial, bit for bit.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from ..config.config import Config
from ..errors import TrainingError
from ..model import residual_field
from ..model.residual_field import ResidualField
from . import ball_repair, part_trial, pose_repair
from .checkpoint import Checkpoint
from .representations import registry, residual
from .trainer import Trainer

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]

MARGIN = 2  # dilation of masks in the comparison, px; non-rigid parts cross the edge
HELD_SHARE, MAX_HELD = 0.2, 20  # share and maximum number of views held out for the comparison
MIN_PIXELS = 50  # pixels of a body in the held-out views below which its gain is unknown
TRIAL = "trial"  # name of the progress events
SEED_STEP = 2  # added to the run's seed for the trial's generator


def decision_step(config: Config, all_entered: int) -> int | None:
    """Return the step after which bodies are tried, None for never.

    Args:
        config: The run's configuration.
        all_entered: Step at which the last observed time joins the training.
    """
    wanted = config.needs
    takes_residuals = registry.configured(config).takes_residuals
    if not takes_residuals or wanted.residuals == "off" or wanted.tracks == "off":
        return None
    step = max(int(config.residual.start * config.train.iterations), all_entered, 1)
    return step if step < config.train.iterations else None


def decide(trainer: Trainer, progress: Progress) -> None:
    """Try residuals on all bodies, then restore the state before the trial with the residuals that help.

    Args:
        trainer: A run whose representation takes residuals, with several observed times.
        progress: Called with events during the trial.
    """
    before = trainer.state()
    trial = _try(trainer, progress)
    kept = flexible(trial.gains, trial.field, trainer.config)
    if kept and trainer.config.needs.residuals != "on" and pose_repair.applies(trainer):
        trainer.restore(before)
        balls = ball_repair.rigid(trainer, kept)  # what they gain are errors of their tracks, which will be repaired
        kept = [body for body in kept if body not in balls]
    gains = {residual.GAINS: torch.from_numpy(trial.gains)}
    state = dataclasses.replace(before, tensors=before.tensors | gains)
    divided = _divided(trainer, state, trial, kept)
    bent = [body for body in kept if body not in divided]
    state = list(divided.values())[-1] if divided else state
    if bent:
        state = dataclasses.replace(state, tensors=state.tensors | residual.tensors_of(trial.field.only(bent)))
    trainer.restore(state)
    found = ", ".join(f"{i} {gain:+.2f} dB" for i, gain in zip(trainer.object_ids[1:], trial.gains, strict=True))
    log.info("residuals: gains by object %s; kept for %d, parts for %d", found or "none", len(bent), len(divided))


def _divided(trainer: Trainer, state: Checkpoint, trial: Trial, bodies: Sequence[int]) -> dict[int, Checkpoint]:
    """Return the bodies that consist of parts, each with the state in which it and all before it are divided."""
    found: dict[int, Checkpoint] = {}
    if trainer.config.needs.residuals == "on":
        return found
    for body in bodies:
        limit, steps = float(trial.errors[0, body - 1]), trial_steps(trainer.config)
        field = trial.field.only([body])
        divided = part_trial.divide(trainer, state, body, field, limit, trial.held, trial.used, steps)
        if divided is not None:
            found[body] = state = divided
    return found


@dataclass(frozen=True)
class Trial:
    """Result of a trial.

    Attributes:
        field: Residuals of all bodies.
        gains: Gain of each body, dB, nan if unknown. [B - 1]
        errors: Summed squared errors of each body on the held-out views, with and without its residuals. [2, B - 1]
        held: Held-out views.
        used: Views used for training.
    """

    field: ResidualField
    gains: np.ndarray
    errors: np.ndarray
    held: list[int]
    used: list[int]


def flexible(gains: np.ndarray, field: ResidualField, config: Config) -> list[int]:
    """Return the bodies that keep their residuals: those with enough gain, or all if ``needs.residuals`` is "on"."""
    if config.needs.residuals == "on":
        return field.bodies
    return [body for body in field.bodies if gains[body - 1] > config.residual.threshold]


def trial_steps(config: Config) -> int:
    """Return the number of steps of the trial; like the curriculum, it is shortened in short runs."""
    return max(1, int(config.residual.trial_steps * min(1.0, config.train.iterations / 2000)))


def _try(trainer: Trainer, progress: Progress) -> Trial:
    """Train all bodies with residuals, and compare their errors with and without them."""
    config, state, ids = trainer.config, trainer.state(), trainer.object_ids[1:]
    means, motion_ids, logits = (state.tensors[f"gaussians.{n}"] for n in ("means", "motion_ids", "opacity_logits"))
    bodies = list(range(1, len(ids) + 1))
    field = residual_field.spread(
        means, motion_ids, torch.sigmoid(logits), bodies, config.residual.nodes, len(trainer.times)
    )
    unknown = np.full(len(ids), np.nan)
    draws = torch.Generator().manual_seed(config.train.seed + SEED_STEP)
    order = torch.randperm(len(trainer.views), generator=draws).tolist()
    held, used = split([i for i in order if _shows(trainer.views[i].mask, ids)])
    nothing = Trial(field, unknown, np.zeros((2, len(ids))), held, used)
    if not field.bodies or not held:
        return nothing
    trainer.restore(dataclasses.replace(state, tensors=state.tensors | residual.tensors_of(field)))
    steps = trial_steps(config)
    trainer.curriculum.queue = [used[k % len(used)] for k in range(steps * config.train.batch)]
    try:
        for step in range(1, steps + 1):
            trainer.step()
            if step % config.train.log_every == 0 or step == steps:
                progress({"event": TRIAL, "done": step, "total": steps, "unit": "steps"})
    except TrainingError as error:
        log.warning("the trial of residuals failed, all bodies stay rigid: %s", error)
        return nothing
    learned, trained = residual.residual_of(trainer.state().tensors), trainer.motion.residuals
    assert learned is not None and trained is not None
    gains, errors = _gains(trainer, trained, held)
    return Trial(learned, gains, errors, held, used)


def _shows(mask: np.ndarray | None, ids: np.ndarray) -> bool:
    return mask is not None and bool(np.isin(mask, ids).any())


def split(order: Sequence[int]) -> tuple[list[int], list[int]]:
    """Split shuffled views into held-out views for the comparison and views for the trial.

    There are no held-out views if ``order`` has too few.
    """
    count = min(MAX_HELD, int(HELD_SHARE * len(order)))
    return list(order[:count]), list(order[count:])


@torch.no_grad()
def _gains(trainer: Trainer, field: ResidualField, held: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the increase of the error on each body if only its residuals are left out, dB, and both errors.

    [B - 1], [2, B - 1]
    """
    ids = trainer.object_ids[1:]
    errors, pixels = np.zeros((2, len(ids))), np.zeros(len(ids))
    for index in held:
        view = trainer.views[index]
        mask = view.mask
        assert mask is not None
        truth = torch.from_numpy(view.image).float() / 255
        whole = _squares(trainer, field, index, truth)
        for body in field.bodies:
            region = mask == ids[body - 1]
            if not region.any():
                continue
            region = np.asarray(ndimage.binary_dilation(region, iterations=MARGIN), bool)
            others = field.only([b for b in field.bodies if b != body])
            pixels[body - 1] += region.sum()
            errors[0, body - 1] += whole[region].sum()
            errors[1, body - 1] += _squares(trainer, others, index, truth)[region].sum()
    gains = 10 * np.log10(np.maximum(errors[1], 1e-12) / np.maximum(errors[0], 1e-12))
    return np.where(pixels >= MIN_PIXELS, gains, np.nan), errors


def _squares(trainer: Trainer, field: ResidualField, index: int, truth: Tensor) -> np.ndarray:
    """Return the squared error of each pixel with ``field`` in place of the trial's field. [H, W] float64"""
    view = trainer.views[index]
    trainer.motion.residuals = field
    return ((trainer.render(view.camera, view.t).cpu() - truth) ** 2).sum(-1).numpy().astype(np.float64)

"""Bodies that are not rigid, found by trying: residuals are given to all bodies for a while and kept where they help.

Once every time takes part and the tracks have settled, the run goes on for some steps with a residual field on all
bodies. Then each body's residuals are left out in turn: views that these steps did not use say by how much the error
on the body grows. After that the run goes back to where it was, and bodies that lost more than a threshold keep
their residuals. Those that did not are left without a trace: where none is flexible, the run goes on to the same bits
as one that never tried.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from ..errors import TrainingError
from ..model import residual_field
from ..model.residual_field import Change, ResidualField
from ..model.tracks import Tracks
from ..motion import rotations
from . import checkpoint_content
from . import shading as shading_vectors
from .config import Config
from .groups import PointMotion

if TYPE_CHECKING:
    from .trainer import Trainer

log = logging.getLogger(__name__)

MARGIN = 2  # pixels around a mask that count to its object: what bends crosses its edge
HELD_SHARE, MAX_HELD = 0.2, 20  # views that the trial leaves for the comparison
MIN_PIXELS = 50  # on these together, below which nothing is said of a body
TRIAL = "trial"  # name of its events
SEED_STEP = 2  # the trial draws from a generator of its own
PREFIX = "residual."
GAINS = checkpoint_content.RESIDUAL_GAINS


def decision_step(config: Config, all_entered: int) -> int | None:
    """Step after which bodies are tried, None for never.

    Args:
        config: The run's configuration.
        all_entered: Step at which the last observed time joins the training.
    """
    wanted = config.needs
    if config.train.representation != "tracks" or wanted.residuals == "off" or wanted.tracks == "off":
        return None
    step = max(int(config.residual.start * config.train.iterations), all_entered, 1)
    return step if step < config.train.iterations else None


def decide(trainer: Trainer) -> None:
    """Try residuals on all bodies, and go on from where the run was with those that help.

    With one observed time nothing can bend, so that nothing is tried.
    """
    if len(trainer.times) < 2:
        return
    before = trainer.state()
    field, gains = _try(trainer)
    kept = flexible(gains, field, trainer.config)
    added = {GAINS: torch.from_numpy(gains)}
    if kept:
        added |= tensors_of(field.only(kept))
    trainer.restore(dataclasses.replace(before, tensors=before.tensors | added))
    found = ", ".join(f"{i} {gain:+.2f} dB" for i, gain in zip(trainer.object_ids[1:], gains, strict=True))
    log.info("residuals: gains by object %s; kept for %d", found or "none", len(kept))


def flexible(gains: np.ndarray, field: ResidualField, config: Config) -> list[int]:
    """Bodies that keep their residuals: those that gain more than the threshold, or all where you say so."""
    if config.needs.residuals == "on":
        return field.bodies
    return [body for body in field.bodies if gains[body - 1] > config.residual.threshold]


def trial_steps(config: Config) -> int:
    """Length of the trial; shorter in runs that are too short for it, as the curriculum."""
    return max(1, int(config.residual.trial_steps * min(1.0, config.train.iterations / 2000)))


def _try(trainer: Trainer) -> tuple[ResidualField, np.ndarray]:
    """The field after the trial, and what each body gains by it, dB, nan where that cannot be said. [B - 1]"""
    config, g, ids = trainer.config, trainer.gaussians, trainer.object_ids[1:]
    opacities = torch.sigmoid(g.params["opacity_logits"].detach())
    bodies = list(range(1, len(ids) + 1))
    field = residual_field.spread(
        g.params["means"].detach(), g.motion_ids, opacities, bodies, config.residual.nodes, len(trainer.times)
    )
    unknown = np.full(len(ids), np.nan)
    draws = torch.Generator().manual_seed(config.train.seed + SEED_STEP)
    order = torch.randperm(len(trainer.views), generator=draws).tolist()
    held, used = split([i for i in order if _shows(trainer.views[i].mask, ids)])
    if not field.bodies or not held:
        return field, unknown
    state = trainer.state()
    trainer.restore(dataclasses.replace(state, tensors=state.tensors | tensors_of(field)))
    steps = trial_steps(config)
    trainer.queue = [used[k % len(used)] for k in range(steps)]
    try:
        for step in range(1, steps + 1):
            trainer.step()
            if step % config.train.log_every == 0 or step == steps:
                trainer.progress({"event": TRIAL, "done": step, "total": steps, "unit": "steps"})
    except TrainingError as error:
        log.warning("residuals cannot be tried, all bodies stay rigid: %s", error)
        return field, unknown
    learned = residual_of(trainer.state().tensors)
    assert learned is not None
    return learned, _gains(trainer, learned, held)


def _shows(mask: np.ndarray | None, ids: np.ndarray) -> bool:
    return mask is not None and bool(np.isin(mask, ids).any())


def split(order: Sequence[int]) -> tuple[list[int], list[int]]:
    """Views for the comparison and views for the trial, out of shuffled ones; none held where there are too few."""
    count = min(MAX_HELD, int(HELD_SHARE * len(order)))
    return list(order[:count]), list(order[count:])


@torch.no_grad()
def _gains(trainer: Trainer, field: ResidualField, held: Sequence[int]) -> np.ndarray:
    """By how much the error on each body grows when it alone is without residuals, dB. [B - 1]"""
    ids = trainer.object_ids[1:]
    errors, pixels = np.zeros((2, len(ids))), np.zeros(len(ids))
    for index in held:
        view = trainer.views[index]
        assert view.mask is not None
        truth = torch.from_numpy(view.image).float() / 255
        whole = _squares(trainer, field, index, truth)
        for body in field.bodies:
            region = view.mask == ids[body - 1]
            if not region.any():
                continue
            region = np.asarray(ndimage.binary_dilation(region, iterations=MARGIN), bool)
            others = field.only([b for b in field.bodies if b != body])
            pixels[body - 1] += region.sum()
            errors[0, body - 1] += whole[region].sum()
            errors[1, body - 1] += _squares(trainer, others, index, truth)[region].sum()
    gains = 10 * np.log10(np.maximum(errors[1], 1e-12) / np.maximum(errors[0], 1e-12))
    return np.where(pixels >= MIN_PIXELS, gains, np.nan)


def _squares(trainer: Trainer, field: ResidualField, index: int, truth: Tensor) -> np.ndarray:
    """Squared error of each pixel with a field in place of the trial's. [H, W] float64"""
    view = trainer.views[index]
    trainer.motion.residuals = field  # type: ignore[reportAttributeAccessIssue]: `tracks` alone is tried
    return ((trainer.render(view.camera, view.t) - truth) ** 2).sum(-1).numpy().astype(np.float64)


def tensors_of(field: ResidualField) -> dict[str, Tensor]:
    """A field as named tensors of a checkpoint."""
    named = {"nodes": field.nodes, "owners": field.owners, "values": field.values.detach()}
    return {f"{PREFIX}{name}": tensor for name, tensor in named.items()}


def residual_of(tensors: Mapping[str, Tensor]) -> ResidualField | None:
    """The field in a checkpoint's named tensors, None where all bodies are rigid."""
    if f"{PREFIX}values" not in tensors:
        return None
    nodes, owners, values = (tensors[f"{PREFIX}{name}"].clone() for name in ("nodes", "owners", "values"))
    return ResidualField(nodes, owners, values)


def relight(
    change: Change, colors: Tensor, shading: Tensor, light: Tensor, rotmats: Tensor, groups: Tensor
) -> tuple[Tensor, Tensor]:
    """Colours and shading vectors in which what turns on its own is lit by its own rotation.

    Args:
        change: The members of flexible bodies and how they turn.
        colors: Colours of all Gaussians, before the shading. [N, 3]
        shading: The vectors g. [N, 3]
        light: The vector l. [3]
        rotmats: Rotations of the motion groups. [G, 3, 3]
        groups: Group of each member. [n]

    Returns:
        Colours with the members' shading in them [N, 3], and vectors that are zero for the members [N, 3].
    """
    seen = rotations.rotate(rotations.conjugate(change.quats), (light @ rotmats)[groups])  # l from the member's frame
    factor = (1 + (shading[change.rows] * (seen - light)).sum(1, keepdim=True)).clamp(min=0)
    lit = colors[change.rows].clamp(min=0) * factor
    return colors.index_copy(0, change.rows, lit), shading.index_fill(0, change.rows, 0.0)


@torch.no_grad()
def point_motion(
    field: ResidualField, tracks: Tracks, tensors: Mapping[str, Tensor]
) -> tuple[PointMotion, dict[str, np.ndarray]]:
    """States of the members of flexible bodies at the knots, and the Gaussians that all tracks start from.

    Args:
        field: Their residuals.
        tracks: Tracks of the bodies.
        tensors: The checkpoint's, with all Gaussians.

    Returns:
        States at the knots in training coordinates; and parameters by name in which members have their shape of the
        last knot, moved back to the canonical state.
    """
    names = ("means", "quats", "log_scales", "sh", "sh_rest", "shading")
    g = {name: tensors[f"gaussians.{name}"].double() for name in names}
    ids, centers = tensors["gaussians.motion_ids"], tracks.group_centers().double()
    opacities = torch.sigmoid(tensors["gaussians.opacity_logits"])
    bind = {name: tensor.numpy().copy() for name, tensor in g.items()}
    rows = np.zeros(0, np.int64)
    states: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for s, t in enumerate(tracks.times):
        change = field.change(
            tensors["gaussians.means"], tensors["gaussians.quats"], opacities, ids, tracks.knot_weights(float(t))
        )
        rows, group = change.rows.numpy(), ids[change.rows]
        means = g["means"][change.rows] + change.offsets
        quats = rotations.multiply(change.quats.double(), rotations.normalize(g["quats"][change.rows]))
        sizes = g["log_scales"][change.rows] + change.log_scales
        if s == len(tracks.times) - 1:
            sh = np.concatenate([bind["sh"], bind["sh_rest"]], axis=1)[rows]
            since, light = change.quats.numpy().astype(np.float64), tensors["light"].numpy().astype(np.float64)
            ones = np.ones(len(rows))
            sh, vectors, lit = shading_vectors.rebind(sh, bind["shading"][rows], ones, since, light)
            bind["shading_rest"] = np.ones(len(bind["means"]))
            bind["shading_rest"][rows] = lit
            state = {"means": means.numpy(), "quats": quats.numpy(), "log_scales": sizes.numpy()}
            for name, value in (state | {"sh": sh[:, :1], "sh_rest": sh[:, 1:], "shading": vectors}).items():
                bind[name][rows] = value
        turn = tracks.knot_quats()[:, s].double()[group]
        shift = centers[group] + tracks.params["translations"][:, s].double()[group]
        moved = shift + rotations.rotate(turn, means - centers[group])
        states.append((moved.numpy(), rotations.multiply(turn, quats).numpy(), sizes.numpy()))
    means, quats, sizes = (np.stack(parts, 1) for parts in zip(*states, strict=True))
    return PointMotion(rows, means, quats, sizes), bind


def need(
    tensors: Mapping[str, Tensor], names: Mapping[int, str], config: Config, there: bool
) -> tuple[float, float, bool, str]:
    """What the needs table says of residuals: largest gain, threshold, whether there are any, and the reason.

    Args:
        tensors: The checkpoint's.
        names: Names of the objects by id.
        config: The run's configuration.
        there: Whether the scene has residuals.
    """
    threshold, field = config.residual.threshold, residual_of(tensors)
    if GAINS not in tensors:
        reason = "every Gaussian moves by the deformation field" if there else "gain by bending, dB; none was tried"
        return 0.0, threshold, there, reason
    gains, ids = tensors[GAINS].numpy(), tensors["object_ids"].numpy()
    kept = [] if field is None else field.bodies
    largest = float(np.nanmax(gains)) if np.isfinite(gains).any() else 0.0
    bent = ", ".join(f"{names.get(int(ids[b]), f'object {ids[b]}')} ({gains[b - 1]:+.1f})" for b in kept)
    rigid = f"{len(gains) - len(kept)} of {len(gains)} objects are rigid"
    if kept and not there and config.needs.residuals != "off":
        bent += ", too little to be stored"
    return largest, threshold, there, "gain by bending, dB: " + (f"{bent}; {rigid}" if bent else rigid)

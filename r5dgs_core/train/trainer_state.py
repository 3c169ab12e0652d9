"""State of a `trainer.Trainer`, which imports this module, as a checkpoint."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..model.gaussians import Gaussians
from . import background as backgrounds
from . import checkpoint_content
from . import optimizer as optimizers
from .checkpoint import Checkpoint


def of(trainer: Any) -> Checkpoint:
    """Return everything that the next step of a trainer depends on."""
    tensors: dict[str, Tensor] = {f"gaussians.{n}": p.detach() for n, p in trainer.gaussians.params.items()}
    tensors["gaussians.motion_ids"] = trainer.gaussians.motion_ids
    tensors |= trainer.motion.tensors()
    if trainer.identity is not None:
        tensors |= trainer.identity.tensors(trainer.gaussians)
    if trainer.discovered_masks is not None:
        tensors[checkpoint_content.DISCOVERED_MASKS] = trainer.discovered_masks
    if trainer.unexplained is not None:
        tensors[checkpoint_content.UNEXPLAINED] = trainer.unexplained.tensor()
    tensors["background"] = trainer.background.params["background"].detach()
    tensors["object_ids"] = torch.from_numpy(np.asarray(trainer.object_ids, np.int64))
    tensors["generator"] = trainer.generator.get_state()
    if len(trainer.frozen) == len(trainer.gaussians):
        tensors[checkpoint_content.FROZEN] = trainer.frozen
    tensors |= trainer.densifier.tensors() | trainer.refinement.tensors()
    tensors |= optimizers.tensors(trainer.optimizer)
    x, y, z = (trainer.dataset.origin + trainer.normalization.origin).tolist()
    return Checkpoint(
        tensors={n: t.detach().to("cpu", copy=True) for n, t in tensors.items()},
        representation=trainer.motion.name,
        iteration=trainer.iteration,
        entered=trainer.curriculum.entered,
        first_time=trainer.first_time,
        queue=tuple(trainer.curriculum.queue),
        running_loss=trainer.running_loss,
        origin=(x, y, z),
        scale=float(trainer.normalization.scale),
        observed=torch.from_numpy(trainer.places.shown.copy()),
    )


def restore(trainer: Any, state: Checkpoint) -> None:
    """Restore a state (`of`) of a trainer with the same data set and configuration."""
    # Copies, as training modifies them in place.
    tensors = {name: tensor.to(trainer.device, copy=True) for name, tensor in state.tensors.items()}
    g = {n.removeprefix("gaussians."): t for n, t in tensors.items() if n.startswith("gaussians.")}
    trainer.gaussians = Gaussians({n: t for n, t in g.items() if n != "motion_ids"}, g["motion_ids"])
    trainer.motion = trainer.motion.restored(state.representation, tensors)
    if trainer.identity is not None:
        trainer.identity.restore(tensors, trainer.gaussians)
    trainer.background = backgrounds.Background(tensors["background"], trainer.background.learned)
    trainer.object_ids = state.tensors["object_ids"].numpy().copy()
    try:
        trainer.generator.set_state(state.tensors["generator"])
    except (RuntimeError, TypeError) as error:
        raise CheckpointError(f"the checkpoint's 'generator' is not a state of torch's generator: {error}") from error
    if any(len(t) != len(trainer.gaussians) for n, t in tensors.items() if n.startswith("gradients.")):
        raise CheckpointError(f"the checkpoint's 'gradients.*': expected {len(trainer.gaussians)} rows each")
    trainer.densifier.restore(tensors)
    trainer.refinement.restore(state.tensors)
    trainer.frozen = tensors.get(checkpoint_content.FROZEN, trainer.frozen[:0])
    trainer.optimizer = trainer.make_optimizer()
    optimizers.restore(trainer.optimizer, tensors)
    trainer.iteration = state.iteration
    trainer.curriculum.entered = state.entered
    trainer.first_time = state.first_time
    trainer.curriculum.queue = list(state.queue)

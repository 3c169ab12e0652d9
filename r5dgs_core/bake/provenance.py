"""Last stage of baking: the provenance record of the scene, with its PSNR on the training views."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..data.dataset import View
from ..errors import DatasetError
from ..playback import residuals, scene_player
from ..render import scene_renderer
from ..scene import slipped_rotations
from ..scene.scene import Scene
from ..train import checkpoint_content, train_views, view_psnr
from ..train.identity import label_cleanup
from .draft import Context, Draft


def apply(draft: Draft, context: Context) -> Draft:
    """Write the provenance of the scene."""
    state, moves = context.state, draft.observed.motion.moves
    config = context.config.to_dict()
    if config["needs"]["contact"] == "auto":  # so that scenes without contacts stay the same, byte for byte
        del config["needs"]["contact"]
    record: dict[str, Any] = {
        "config": config,
        "dataset_digest": context.run.digest,
        "versions": context.run.versions,
        "discovered": context.discovered,
        "train": {
            "seconds": state.seconds,
            "iterations": state.iteration,
            "gaussians": len(draft.order),
            "finished": state.finished,
        },
        **_on_training_views(draft, context),
        **slipped_rotations.record(draft.slipped),
    }
    if cameras := context.cameras(draft.scene.gaussians.means):
        record["cameras"] = cameras
    cleaned = label_cleanup.changes_of(context.tensors)
    if cleaned is not None:
        record["label_hygiene"] = cleaned
    if moves is not None:
        unexplained = len(residuals.unexplained(draft.scene))
        record["regrouping"] = dataclasses.asdict(moves) | {"unexplained": unexplained}
    return dataclasses.replace(draft, scene=dataclasses.replace(draft.scene, provenance=record))


def _on_training_views(draft: Draft, context: Context) -> dict[str, Any]:
    """Return the PSNR of the checkpoint and of the scene on the training views, for the provenance.

    A checkpoint of an unfinished or older run does not store its PSNR; the scene with the trained motion is measured
    instead. The result is empty if an image is missing.
    """
    dataset, tensors = context.dataset, context.tensors
    behind = train_views.behind(dataset, context.config)
    try:
        baked = view_psnr.training_psnr(dataset, behind, _renderer(draft.scene), context.explained)
        if checkpoint_content.TRAIN_PSNR in tensors:
            before = float(tensors[checkpoint_content.TRAIN_PSNR])
        else:
            trained = _renderer(draft.trained or draft.scene)
            before = view_psnr.training_psnr(dataset, behind, trained, context.explained)
    except DatasetError:  # `simplify_motion` has logged it
        return {}
    return {"training_views": {"checkpoint_psnr": before, "baked_psnr": baked}}


def _renderer(scene: Scene) -> Callable[[View], np.ndarray]:
    """Return a function that renders the scene at a view. [H, W, 3]"""
    player = scene_player.Player(scene)

    def draw(view: View) -> np.ndarray:
        return scene_renderer.render(player, view.camera, view.t).color

    return draw

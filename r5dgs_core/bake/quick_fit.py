"""Prediction of a run without the training images: the fit of `bake`, in a fraction of its time."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..scene.scene import Scene
from ..train import run_folder
from . import assemble, read_checkpoint, simplify_motion


def scene_of(run: run_folder.Run) -> Scene:
    """Return a scene with the motion past t_max fitted to the trained poses alone, and the record of its cameras.

    Compared with `bake.bake`, slight motion is not checked against the images, and the errors of the poses are unknown.

    Args:
        run: A run folder. Its data set must still be in the place recorded by the training.

    Raises:
        CheckpointError, DatasetError: A file is missing or damaged.
    """
    context = read_checkpoint.open_context(run, None)
    draft = assemble.draft(read_checkpoint.observe(context), context)
    observed = np.stack([group.observed for group in draft.observed.motion.groups])
    scene = simplify_motion.simplify(draft.scene, observed, None, context.wanted).scene
    return dataclasses.replace(scene, provenance={"cameras": context.cameras(scene.gaussians.means)})

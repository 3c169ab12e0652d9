"""A data set with the corrected cameras of a run, and the record of the corrections."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from ...data.dataset import Dataset
from ...data.splits import SPLITS
from ...scene import cameras
from ...scene.camera_correction import Correction
from ..normalization import Normalization
from . import rig
from .refinement import PARTS, Refinement


def corrections(dataset: Dataset, tensors: Mapping[str, Tensor], normalization: Normalization) -> dict[str, Correction]:
    """Return the correction of each training camera by its name, in world units; empty without refinement.

    Args:
        dataset: The data set of the run.
        tensors: Tensors of its checkpoint.
        normalization: World coordinates to training coordinates.
    """
    trained = _restored(dataset, tensors)
    if not trained.active:
        return {}
    scale = normalization.scale
    return {name: trained.correction(row).scaled(scale) for row, name in enumerate(trained.rig.names)}


def apply(dataset: Dataset, found: Mapping[str, Correction]) -> Dataset:
    """Return the data set with corrected cameras and times, and with images in the scene's colours."""
    if not found:
        return dataset
    splits = {}
    for split in SPLITS:
        views = []
        for view in dataset.views(split):
            correction = found.get(view.camera.name)
            if correction is not None:
                camera, t = correction.camera(view.camera), view.t + correction.time
                view = dataclasses.replace(view, camera=camera, t=t, correction=correction)
            views.append(view)
        splits[split] = tuple(views)
    return dataclasses.replace(dataset, **splits)


def record(
    dataset: Dataset, tensors: Mapping[str, Tensor], found: Mapping[str, Correction], points: np.ndarray
) -> dict[str, Any]:
    """Return the record of the refinement for a scene's provenance, in JSON types; empty if none was tried.

    Args:
        dataset: The data set with the given cameras.
        tensors: Tensors of the checkpoint.
        found: The corrections, as from `corrections`.
        points: Points of the scene, world. [N, 3]

    Returns:
        ``seconds_per_unit`` of scene time, or None; ``refined``, the parts; ``sizes`` and ``gains_db`` of each part
        (`agreement.Evidence`); ``corrections`` by camera; and ``pixels``, the shift of the picture of each camera by
        its corrections of pose and focal length (rms).
    """
    trained = _restored(dataset, tensors)
    if trained.gains is None:
        return {}
    given = {view.camera.name: view.camera for view in reversed(dataset.train)}

    def by_part(values: np.ndarray) -> dict[str, float | None]:
        return {part: None if np.isnan(one) else float(one) for part, one in zip(PARTS, values, strict=True)}

    return {
        "seconds_per_unit": dataset.units.seconds_per_unit,
        "refined": [part for part in PARTS if part in trained.parts],
        "sizes": by_part(trained.sizes),
        "gains_db": by_part(trained.gains),
        "corrections": {name: correction.to_dict() for name, correction in found.items()},
        "pixels": {name: pixel_shift(given[name], correction, points) for name, correction in found.items()},
    }


def pixel_shift(camera: cameras.Camera, correction: Correction, points: np.ndarray) -> float:
    """Return the distance between the images of points in the given and in the corrected camera, rms, px."""
    before, _ = cameras.project(camera, points)
    after, _ = cameras.project(correction.camera(camera), points)
    inside = ((before >= 0) & (before < [camera.width, camera.height])).all(1) & np.isfinite(after).all(1)
    return float(np.sqrt(((after - before)[inside] ** 2).sum(1).mean())) if inside.any() else 0.0


def _restored(dataset: Dataset, tensors: Mapping[str, Tensor]) -> Refinement:
    """Return the refinement of a checkpoint."""
    restored = Refinement(rig.of(dataset.train), 1.0, 1)
    restored.restore(dict(tensors))
    return restored

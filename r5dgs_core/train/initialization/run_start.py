"""Initial state and background of a run, from its views, data set and configuration."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np

from ...config.config import Config
from ...data.dataset import Dataset
from ...errors import DatasetError
from ...scene import spherical_harmonics
from ...scene.sampling import spread
from .. import background as backgrounds
from .. import train_views
from ..normalization import Normalization
from ..representations.representation import Representation
from . import background_images, initialize, place_gaussians, sky

log = logging.getLogger(__name__)

SWEEP_BYTES_PER_PIXEL = 64  # of the background images


def initial_state(
    views: Sequence[train_views.TrainView],
    normalization: Normalization,
    dataset: Dataset,
    config: Config,
    motion: type[Representation],
    discovered: bool,
) -> initialize.InitialState:
    """Return the initial state, with at most ``densify.max_gaussians`` Gaussians.

    Args:
        views: Training views in normalised coordinates, with masks if objects are known.
        normalization: World coordinates to normalised ones.
        dataset: The data set.
        config: Configuration of the run.
        motion: Representation that will be trained.
        discovered: True if the masks of the views were discovered; their ids are not those of the data set.

    Raises:
        DatasetError: No Gaussian can be placed.
    """
    rng = np.random.default_rng(config.train.seed)
    find_sky = train_views.behind(dataset, config) is None
    with train_views.lent(views, _sweep_bytes(views)):
        start = initialize.start(views, config, motion, find_sky, rng, _cloud(dataset, normalization))
    if len(start.gaussians) == 0:
        raise DatasetError(
            f"{dataset.root}: no Gaussian can be placed: no mask shows an object, and the background is all sky "
            "or visible to only one camera. Remedy: add masks or cameras"
        )
    missing = sorted(set(dataset.object_names) - {int(i) for i in start.object_ids} - {0, -1})
    if missing and len(start.object_ids) > 1 and not discovered:
        named = ", ".join(f"{i} ({dataset.object_names[i]})" for i in missing)
        log.warning("no training mask shows object %s: left out. Remedy: check the ids in objects.json", named)
    most = config.densify.max_gaussians
    return dataclasses.replace(start, gaussians=place_gaussians.thin(start.gaussians, most, rng)) if most else start


def background(
    views: Sequence[train_views.TrainView], behind: np.ndarray | None, found: np.ndarray | None, config: Config
) -> backgrounds.Background:
    """Return a fixed background, or one that is learned from the sky that was found, or else from the median colour.

    Args:
        views: Training views.
        behind: Fixed colour behind transparent pixels; None if the run learns its background. [3]
        found: Coefficients of the sky, or None. [Kb, 3]
        config: Configuration of the run.
    """
    if behind is not None:
        return backgrounds.fixed(behind)
    degree = 0 if config.needs.sky_gradient == "off" else sky.DEGREE
    return backgrounds.learned(found if found is not None else _median_color(views), degree)


def _sweep_bytes(views: Sequence[train_views.TrainView]) -> int:
    """Return the memory of the background images and their sweep, bytes."""
    some = [group[0].camera for group in train_views.by_camera(views, background_images.MAX_CAMERAS)]
    return SWEEP_BYTES_PER_PIXEL * sum(camera.width * camera.height for camera in some)


def _cloud(dataset: Dataset, normalization: Normalization) -> tuple[np.ndarray, np.ndarray] | None:
    """Return points (normalised coordinates) and colours of the data set's reconstruction; None if it has none."""
    points, colors = dataset.points, dataset.point_colors
    if points is None or colors is None or len(points) == 0:
        return None
    return (points - normalization.origin) / normalization.scale, colors


def _median_color(views: Sequence[train_views.TrainView]) -> np.ndarray:
    """Return coefficients of the median colour of all pixels, for scenes in which no sky was found. [1, 3]

    At most `train_views.MAX_SAMPLE` views are used, spread evenly.
    """
    shown = train_views.in_turn(spread(views, train_views.MAX_SAMPLE), train_views.IMAGE)
    color = np.median([np.median(view.image.reshape(-1, 3), axis=0) for view in shown], axis=0) / 255
    return spherical_harmonics.rgb_to_dc(color)[None]

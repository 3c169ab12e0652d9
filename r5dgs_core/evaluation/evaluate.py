"""Evaluation of a baked scene against the images, masks and true poses of its data set.

The result has a fixed form (docs/reference/evaluation.md) that is comparable across versions. Renderings are rounded to
8 bits before they are measured, as in an image file.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, timing
from ..data import dataset as datasets
from ..data import images
from ..data.explained_pixels import ExplainedPixels
from ..errors import ConfigError
from ..playback import scene_player
from ..render import scene_renderer
from ..scene import predictability
from ..scene.camera_correction import Correction
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import alignment, explained, ground_truth_poses, lpips, metrics, miou

METRICS = (
    "psnr",
    "psnr_aligned",
    "psnr_explained",
    "psnr_pooled",
    "psnr_objects",
    "ssim",
    "ssim_objects",
    "flip",
    "lpips",
    *miou.KEYS,
    "ms_motion",
    "ms_raster",
    "images",
    "images_later",
)
_SAME_TIME = 1e-9  # scene time
Move = Callable[[float, np.ndarray], scene_player.Frame]  # from a time and an origin [3], as `Player.frame`


@dataclass(frozen=True)
class Rendering:
    """Rendered picture of a scene.

    Attributes:
        color: Display-referred sRGB, rounded to 8 bits. [H, W, 3] float32
        ids: Object of each pixel, 0 = background. [H, W] int32
        ms_motion: Time to move the Gaussians, milliseconds.
        ms_raster: Time to rasterize them, milliseconds.
    """

    color: np.ndarray
    ids: np.ndarray
    ms_motion: float
    ms_raster: float


def evaluate(
    scene: Scene,
    dataset: datasets.Dataset,
    *,
    modes: Sequence[str] = ("rigid",),
    splits: Sequence[str] = ("val", "test"),
    background: np.ndarray | None = None,
    backend: str = "auto",
    train: dict[str, Any] | None = None,
    align: bool | None = None,
    perceptual: lpips.Lpips | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure a scene on the held-out views of a data set.

    Args:
        scene: The scene.
        dataset: Its data set.
        modes: Playback modes past t_max, from `scene_player.modes`.
        splits: Splits to measure.
        background: Color behind transparent pixels of the true images, sRGB; `truth_background` if None. [3]
        backend: Rasterizer.
        train: Cost of training: "seconds", "iterations", "gaussians".
        align: True to measure with aligned cameras, too (`alignment`); None if the training has refined its cameras.
        perceptual: Network for LPIPS, or None.
        progress: Called with the number of measured images and the total.

    Returns:
        ``{"scene", "splits": {split: {mode: METRICS}}, "objects": [...], "horizon", "train": {...}}`` in JSON
        types. Values that cannot be computed are None.
    """
    background = truth_background(scene) if background is None else background
    count = counter(progress, sum(len(dataset.views(split)) for split in splits) * len(modes))
    result: dict[str, Any] = {"scene": scene.name, "splits": {}, "objects": object_errors(scene, dataset.ground_truth)}
    result["horizon"] = predictability.horizon(scene)
    corrections, explained_pixels = None, explained.pixels(scene, dataset, background)
    if align or (align is None and scene.provenance.get("cameras", {}).get("refined")):
        held_out = [view for split in splits for view in dataset.views(split)]
        corrections = alignment.corrections(scene, held_out, background, backend, explained_pixels)
    for split in splits:
        result["splits"][split] = {}
        views = dataset.views(split)
        for mode in modes:
            result["splits"][split][mode] = measure_views(
                scene,
                views,
                scene_player.Player(scene, mode).frame,
                background=background,
                backend=backend,
                corrections=corrections,
                explained_pixels=explained_pixels,
                perceptual=perceptual,
                measured=count,
            )
    if perceptual is not None:
        result["lpips_network"] = perceptual.name
    result["train"] = _cost(scene, train)
    return result


def counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[], None]:
    """Return a function that reports one more measured image with each call."""
    done = itertools.count(1)
    return lambda: None if progress is None else progress(next(done), total)


def _cost(scene: Scene, train: dict[str, Any] | None) -> dict[str, Any]:
    """Return the cost of training, as given or else as recorded in the scene."""
    given = train if train is not None else scene.provenance.get("train", {})
    return {
        "seconds": given.get("seconds"),
        "iterations": given.get("iterations"),
        "gaussians": given.get("gaussians", len(scene.gaussians.means)),
    }


def measure_views(
    scene: Scene,
    views: Sequence[datasets.View],
    move: Move,
    *,
    background: np.ndarray | None = None,
    backend: str = "auto",
    corrections: Mapping[str, Correction] | None = None,
    explained_pixels: ExplainedPixels | None = None,
    perceptual: lpips.Lpips | None = None,
    measured: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Measure pictures of a scene whose Gaussians are moved by a function.

    Args:
        scene: The scene.
        views: Cameras, times and true images.
        move: Returns the scene's Gaussians from a time and an origin.
        background: Color behind transparent pixels of the true images, sRGB; `truth_background` if None. [3]
        backend: Rasterizer.
        corrections: Correction of each camera by its name, for ``psnr_aligned``; None leaves that out.
        explained_pixels: Pixels for ``psnr_explained``; None leaves that out.
        perceptual: Network for ``lpips``, or None.
        measured: Called after each image.

    Returns:
        METRICS; values that cannot be computed are None.
    """
    background = truth_background(scene) if background is None else background
    tally = _Tally([item.id for item in scene.objects if item.id > 0], perceptual)
    for view in (views[0], views[-1]) if views else ():  # compiles kernels and fills caches before timing
        render_timed(scene, view.camera, view.t, move, backend=backend)
    for view in views:
        rendering = render_timed(scene, view.camera, view.t, move, backend=backend)
        truth, mask = datasets.load_image(view, background), datasets.load_mask(view)
        tally.add(rendering, truth, mask, is_later(scene, view.t))
        picture = rendering.color
        if corrections is not None:
            picture = _aligned(scene, view, corrections[view.camera.name], move, backend)
            tally.values["psnr_aligned"].append(metrics.psnr(picture, truth))
        where = None if explained_pixels is None else explained_pixels.of(view, truth, mask)
        if where is not None:
            tally.values["psnr_explained"].append(metrics.psnr(picture, truth, where))
        if measured is not None:
            measured()
    return tally.result()


def _aligned(scene: Scene, view: datasets.View, correction: Correction, move: Move, backend: str) -> np.ndarray:
    """Return the picture of a corrected camera in that camera's colours, rounded to 8 bits. [H, W, 3]"""
    camera = correction.camera(view.camera)
    color = scene_renderer.render_frame(
        scene, move(view.t + correction.time, camera.center), camera, backend=backend
    ).color
    return images.to_uint8(correction.seen(color)).astype(np.float32) / np.float32(255.0)


def write(evaluation: dict[str, Any], path: Path) -> Path:
    """Write an evaluation as JSON; returns ``path``.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        atomic_files.write(path, json.dumps(evaluation, indent=2).encode())
    except OSError as error:
        raise ConfigError(f"{path}: the evaluation cannot be written: {error}") from error
    return path


def render(scene: Scene, camera: Camera, t: float, mode: str = "rigid", *, backend: str = "auto") -> Rendering:
    """Render color and object ids of a scene at a time; see `render_timed`."""
    return render_timed(scene, camera, t, scene_player.Player(scene, mode).frame, backend=backend)


def render_timed(scene: Scene, camera: Camera, t: float, move: Move, *, backend: str = "auto") -> Rendering:
    """Render color and object ids of a scene moved by a function, and measure the time in milliseconds.

    The id of a pixel is the classifier's prediction for the blended identities if the scene has both, else the object
    with the largest weight in the pixel.
    """
    watch = timing.Stopwatch()
    frame = move(t, camera.center)
    ms_motion = watch.lap()
    classified = scene.gaussians.identities is not None and scene.classifier is not None
    output = scene_renderer.render_frame(
        scene, frame, camera, backend=backend, features=scene.gaussians.identities if classified else None
    )
    color = output.color
    ms_raster = watch.lap()
    ids = classify(scene, output.features) if classified else np.maximum(output.ids, 0)
    rounded = images.to_uint8(color).astype(np.float32) / np.float32(255.0)
    return Rendering(rounded, ids, ms_motion, ms_raster)


def truth_background(scene: Scene) -> np.ndarray:
    """Return the color that training put behind transparent pixels: black if configured, else white. [3] float32"""
    train = scene.provenance.get("config", {}).get("train", {})
    return np.zeros(3, np.float32) if train.get("background") == "black" else np.ones(3, np.float32)


def classify(scene: Scene, features: np.ndarray) -> np.ndarray:
    """Return the object of each pixel from its blended identity encoding: argmax of the scene's classifier.

    Args:
        scene: A scene with a classifier.
        features: Blended identities, no background term. [H, W, 16]

    Returns:
        Object ids. [H, W] int32

    Source: Gaussian Grouping (Ye et al. 2024), section 3.2.
    """
    if scene.classifier is None:
        raise ValueError("the scene has no classifier")
    classes = np.array([item.id for item in scene.objects if item.id >= 0], np.int32)
    if scene.classifier.weight.shape[0] != len(classes):
        raise ValueError(f"expected {len(classes)} rows in classifier_weight, got {scene.classifier.weight.shape[0]}")
    logits = features @ scene.classifier.weight.T.astype(np.float32) + scene.classifier.bias.astype(np.float32)
    return classes[logits.argmax(axis=-1)]


def object_errors(scene: Scene, ground_truth: datasets.GroundTruth | None) -> list[dict[str, Any]]:
    """Return the error of each object's predicted pose at the last time of the ground truth.

    The object frames in the scene and in the ground truth differ by a constant rigid offset, which is estimated from
    the observed times at which the object was seen (`ground_truth_poses.bodies`).

    Returns:
        Per object ``id name position_error rotation_error_deg warning half_width half_width_percent``, in world units
        and degrees, of the worst of its true bodies. The errors are None if the object has no true pose or no motion
        group, the others if the scene stores no confidence band (`predictability.Outlook`). Without ground truth, one
        row per object of the scene.
    """
    named = {item.id: item.name for item in scene.objects if item.id > 0}
    known: tuple[ground_truth_poses.Body, ...] = ()
    if ground_truth is not None:
        known = ground_truth_poses.bodies(scene, ground_truth)
        if not scene.provenance.get("discovered"):  # ids of discovered objects do not correspond to the true ids
            named = dict(zip(ground_truth.object_ids, ground_truth.names, strict=True)) | named
    outlooks = predictability.outlooks(scene)
    rows: dict[int, dict[str, Any]] = {
        key: {"id": key, "name": name, "position_error": None, "rotation_error_deg": None}
        | outlooks.get(key, predictability.UNKNOWN).prediction()
        for key, name in named.items()
    }
    for body in known:
        predicted = ground_truth_poses.motion(scene, [body.group], body.times[-1:])[0]
        position, angle = metrics.pose_errors(predicted, body.motion[-1:], body.group.pivot)
        errors = {"position_error": float(position[0]), "rotation_error_deg": float(angle[0])}
        row = rows[body.object_id]
        row.update({name: max(error, row[name] or 0.0) for name, error in errors.items()})
    return [rows[key] for key in sorted(rows)]


def is_later(scene: Scene, t: float) -> bool:
    """Return True if a time is past the scene's t_max, so that the scene extrapolates."""
    return t > scene.t_max + _SAME_TIME


class _Tally:
    """Accumulator of the errors of a split's images."""

    def __init__(self, ids: list[int], perceptual: lpips.Lpips | None = None) -> None:
        self.perceptual = perceptual
        self.values: dict[str, list[float]] = {name: [] for name in METRICS}
        self.errors: list[float] = []
        self.overlap = miou.Overlap(ids)
        self.later = 0

    def add(self, rendering: Rendering, truth: np.ndarray, mask: np.ndarray | None, later: bool) -> None:
        self.later += later
        self.errors.append(metrics.mse(rendering.color, truth))
        self.values["psnr"].append(metrics.psnr_of_mse(self.errors[-1]))
        similarity = metrics.ssim_map(rendering.color, truth)
        self.values["ssim"].append(float(similarity.mean()))
        flip = metrics.flip(rendering.color, truth)
        if flip is not None:
            self.values["flip"].append(flip)
        if self.perceptual is not None:
            self.values["lpips"].append(self.perceptual.distance(rendering.color, truth))
        if mask is not None:
            shown = miou.objects_of(mask)
            self.values["psnr_objects"].append(metrics.psnr(rendering.color, truth, shown))
            if shown.any():
                self.values["ssim_objects"].append(float(similarity[shown].mean()))
            self.overlap.add(rendering.ids, mask)
        self.values["ms_motion"].append(rendering.ms_motion)
        self.values["ms_raster"].append(rendering.ms_raster)

    def result(self) -> dict[str, Any]:
        out: dict[str, Any] = dict.fromkeys(METRICS)
        for name in ("psnr", "psnr_aligned", "psnr_explained", "psnr_objects", "ssim", "ssim_objects", "flip", "lpips"):
            out[name] = _mean(self.values[name])
        for name in ("ms_motion", "ms_raster"):
            out[name] = float(np.median(self.values[name])) if self.values[name] else None
        out["psnr_pooled"] = metrics.psnr_pooled(self.errors) if self.errors else None
        out |= self.overlap.result()
        out["images"], out["images_later"] = len(self.errors), self.later
        return out


def _mean(values: Sequence[float]) -> float | None:
    """Mean of the values that are not NaN; None if there are none."""
    kept = [value for value in values if not math.isnan(value)]
    return float(np.mean(kept)) if kept else None

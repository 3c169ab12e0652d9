"""Capture any .blend as a training data set in the D-NeRF layout, rendered by Cycles with exact object masks.

Each view is rendered once for colours and object ids. Afterwards, even after an error, the scene is restored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.scene import sampling
from ..export import frame_range
from ..ui.stepwise_operator import Step
from . import cameras, captured_objects, files, render
from .overrides import Overrides
from .settings import SPLITS, CaptureSettings

MAX_OBJECTS = 32767  # Blender's highest pass index


@dataclass(frozen=True)
class CaptureResult:
    """Result of a finished capture.

    Attributes:
        directory: Folder of the data set.
        images: Number of images of each split.
        objects: Name of each object id.
        unseen: Names of objects that appear in no image.
    """

    directory: Path
    images: dict[str, int]
    objects: dict[int, str]
    unseen: tuple[str, ...]


@dataclass(frozen=True)
class TimePlan:
    """Frames of each split; sub-frames are fractions.

    Attributes:
        start: Frame of t = 0.
        end: Frame of t = 1.
        observed: Frames of the train split.
        val: Frames of the val split.
        test: Frames of the test split.
    """

    start: int
    end: int
    observed: tuple[float, ...]
    val: tuple[float, ...]
    test: tuple[float, ...]

    def time(self, frame: float) -> float:
        """Scene time of a frame, or 0 if the range is a single frame."""
        return (frame - self.start) / (self.end - self.start) if self.end > self.start else 0.0

    @property
    def frames(self) -> tuple[float, ...]:
        """All frames, increasing, each once."""
        return tuple(sorted({*self.observed, *self.val, *self.test}))


def plan_times(settings: CaptureSettings, scene_start: int, scene_end: int) -> TimePlan:
    """Divide a frame range into the three splits.

    Args:
        settings: Frame range, step, t_max and the strides of val and test.
        scene_start: First frame if the settings have none.
        scene_end: Last frame if the settings have none.

    Returns:
        Frames of each split.
    """
    start = scene_start if settings.frame_start is None else settings.frame_start
    end = scene_end if settings.frame_end is None else settings.frame_end
    if end < start:
        raise errors.ConfigError(f"capture: expected frame_end >= frame_start, got {start} to {end}")
    frames = [float(frame) for frame in range(start, end + 1, settings.frame_step)]
    last_observed = start + settings.t_max * (end - start) + 1e-6
    observed = [frame for frame in frames if frame <= last_observed]
    later = [frame for frame in frames if frame > last_observed]
    first = min(1, len(observed) - 1)
    val = observed[first :: settings.val_every]
    if settings.val_between:
        gaps = zip(observed[:-1], observed[1:], strict=True)
        middles = [0.5 * (a + b) for a, b in gaps]
        val = sorted(val + middles[first + settings.val_every // 2 :: settings.val_every])
    return TimePlan(start, end, tuple(observed), tuple(val), tuple(later[:: settings.test_every]))


def check_settings(settings: CaptureSettings) -> None:
    """Raise a `ConfigError` for the first invalid setting."""
    at_least_one = ("resolution_x", "resolution_y", "samples", "frame_step", "val_every", "test_every")
    for name in at_least_one:
        if getattr(settings, name) < 1:
            raise errors.ConfigError(f"capture.{name}: expected at least 1, got {getattr(settings, name)}")
    for name in ("rig_observed", "rig_novel", "test_views", "rig_radius"):
        if getattr(settings, name) < 0:
            raise errors.ConfigError(f"capture.{name}: expected at least 0, got {getattr(settings, name)}")
    if not 0.0 <= settings.t_max <= 1.0:
        raise errors.ConfigError(f"capture.t_max: expected a time in [0, 1], got {settings.t_max}")
    if not 0.0 < settings.rig_fov_deg < 180.0:
        raise errors.ConfigError(f"capture.rig_fov_deg: expected degrees between 0 and 180, got {settings.rig_fov_deg}")
    choices = {"rig": cameras.RIGS, "objects": captured_objects.CHOICES, "device": ("CPU", "GPU")}
    for name, allowed in choices.items():
        value = getattr(settings, name)
        if value not in allowed:
            raise errors.ConfigError(f"capture.{name}: expected one of {', '.join(allowed)}, got {value!r}")


def capture(
    context: bpy.types.Context,
    settings: CaptureSettings,
    progress: Callable[[Step], None] | None = None,
) -> CaptureResult:
    """Capture the context's scene to a data set folder. See `steps` for the errors raised."""
    running = steps(context, settings)
    while True:
        try:
            state = next(running)
        except StopIteration as end:
            return end.value
        if progress is not None:
            progress(state)


def steps(context: bpy.types.Context, settings: CaptureSettings) -> Iterator[Step]:
    """Capture image by image, so that the caller can show progress and stop in between.

    Closing the iterator early restores the scene and leaves no folder behind. The iterator returns the `CaptureResult`.

    Args:
        context: Context whose scene and view layer are captured.
        settings: Capture settings.

    Yields:
        Progress after each image.

    Raises:
        ConfigError: A setting is invalid, or the scene has no usable camera or object.
        DatasetError: The folder exists and is not empty.
        BackendError: OpenImageIO or Cycles is missing.
    """
    check_settings(settings)
    files.require_openimageio()
    scene = context.scene
    plan = plan_times(settings, scene.frame_start, scene.frame_end)
    with Overrides() as overrides, files.new_folder(Path(settings.directory)) as folder:
        overrides.enter_context(frame_range.frame_kept(scene))
        survey = captured_objects.survey(context, plan.frames, overrides)
        objects = captured_objects.choose(context.view_layer, survey, settings.objects, settings.object_collection)
        highest = max(o.id for o in objects)
        _check_ids(highest)
        captured_objects.assign_ids(objects, overrides)
        views = cameras.choose(context, settings, captured_objects.bounds(survey, objects), overrides)
        temporary = render.prepare(context, settings, overrides)
        frames: dict[str, list[dict]] = {split: [] for split in SPLITS}
        seen: set[int] = set()
        jobs = list(_jobs(plan, views, settings.test_views))
        for done, (split, frame, view) in enumerate(jobs):
            scene.frame_set(math.floor(frame), subframe=frame - math.floor(frame))
            scene.cycles.seed = (settings.seed + done) % 2**31
            image, ids = render.render_view(context, view.camera, settings.transparent, temporary)
            seen.update(np.unique(ids).tolist())
            stem = f"{split}/r_{len(frames[split]):04d}"
            files.write_view(folder, stem, image, ids, wide=highest > 255)
            camera = cameras.describe(context, view.camera, settings.resolution_x, settings.resolution_y)
            frames[split].append({"file_path": f"./{stem}", "time": plan.time(frame), "view": view.name, **camera})
            yield Step(done + 1, len(jobs), stem)
        header = {
            "frames_per_unit": float(max(plan.end - plan.start, 1)),
            "w": settings.resolution_x,
            "h": settings.resolution_y,
        }
        for split in SPLITS:
            files.write_transforms(folder, split, header, frames[split])
        files.write_json(folder / "objects.json", {str(o.id): o.name for o in objects})
        files.write_json(folder / "ground_truth.json", _ground_truth(plan, survey, objects))
    return CaptureResult(
        directory=Path(settings.directory),
        images={split: len(frames[split]) for split in SPLITS},
        objects={o.id: o.name for o in objects},
        unseen=tuple(o.name for o in objects if o.id not in seen),
    )


def _check_ids(highest: int) -> None:
    if highest > MAX_OBJECTS:
        raise errors.ConfigError(
            f"capture: expected ids up to {MAX_OBJECTS}, Blender's highest pass index, found up to {highest}; "
            "join objects, or choose fewer by collection"
        )


def _jobs(plan: TimePlan, views: cameras.Views, test_views: int) -> Iterator[tuple[str, float, cameras.NamedCamera]]:
    """Split, frame and view of every image, grouped by frame because changing the frame costs most."""
    later_views = sampling.spread(views.observed, test_views) + list(views.novel)
    for frame in plan.frames:
        if frame in plan.observed:
            yield from (("train", frame, view) for view in views.observed)
        if frame in plan.val:
            yield from (("val", frame, view) for view in views.novel)
        if frame in plan.test:
            yield from (("test", frame, view) for view in later_views)


def _ground_truth(
    plan: TimePlan, survey: captured_objects.Survey, objects: tuple[captured_objects.CapturedObject, ...]
) -> dict:
    """Rigid pose of every object at every captured time, as written to ``ground_truth.json``."""
    rows = [
        {"name": o.name, "id": o.id, "matrices": [m.tolist() for m in captured_objects.poses(survey, o)]}
        for o in objects
    ]
    t_max = plan.time(plan.observed[-1])
    return {"times": [plan.time(frame) for frame in plan.frames], "t_max": t_max, "objects": rows}

"""Preparation of a data set from recordings: resumable, in memory that does not grow with the number of frames.

The record ``capture.json`` is written before the images and holds all measurements. The same command continues from it:
it measures nothing again and writes only missing images, so that the result is that of an uninterrupted run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, folder_lock
from ..capture.calibration.calibration import Calibration
from ..capture.reconstruction import gauge
from ..data import images
from . import (
    cameras,
    capture_file,
    clocks,
    data_splits,
    existing_dataset,
    frame_choice,
    frame_masks,
    image_size,
    record,
    unknown_cameras,
)
from .cameras import Camera
from .frame_choice import Choice
from .plan import Plan, Request

_LISTED = 5  # cameras that a message names
Progress = Callable[[dict[str, Any]], None]


def prepare(request: Request, progress: Progress) -> Plan:
    """Write a data set.

    Args:
        request: The request.
        progress: Called with progress events.

    Raises:
        ConfigError, DatasetError, BackendError: An input cannot be used.
        CheckpointError: Another process writes to the folder.
    """
    source, out = Path(request.source).resolve(), Path(request.out).resolve()
    if source in (out, *out.parents):
        raise errors.ConfigError(
            f"--out {request.out}: is among the recordings; name a folder outside {request.source}"
        )
    for given in (source, request.masks):
        if given is not None:
            existing_dataset.check_outside(out, given)
    if request.up is not None:
        gauge.check_up(request.up)
    file = request.calibration
    if unknown_cameras.missing(request.source, file):
        with folder_lock.hold(out):
            file = _reconstructed(request, out, progress)
    elif request.unknown != unknown_cameras.UnknownCameras():
        raise errors.UsageError(
            "--board, --lenses, --shared-lens, --moving and --distance apply to cameras without a calibration; leave "
            f"them out, or remove the calibration ({file or 'found beside the recordings'})"
        )
    progress({"event": "read", "text": "recordings and calibration"})
    up = request.up if file == request.calibration else None  # a reconstruction is upright
    opened, calibration = cameras.open_all(request.source, file, request.rate, up, request.meters_per_unit)
    if request.masks is not None:
        frame_masks.find(request.masks, [camera.source for camera in opened])  # a fault is reported at once
    with folder_lock.hold(out):
        identity = record.identity(request, opened, calibration)
        known = _known(out, identity, overwrite=request.overwrite)
        plan = _plan(request, opened, calibration, known, progress)
        if known is None:
            existing_dataset.remove(out)
        finished = known is not None and known.get("finished") is True
        if not finished:  # a finished one stays so, or a stop would permit to replace it without --overwrite
            capture_file.write(out, record.content(plan, identity, finished=False))
        lost = _write_images(plan, out, progress)
        plan = _with_lost(plan, lost)
        record.write_points(plan, out)
        record.write_cameras(plan, out, lost)
        checks = {"checks": known["checks"]} if known is not None and "checks" in known else {}
        capture_file.write(out, {**record.content(plan, identity, finished=True, lost=lost), **checks})
    return plan


def _reconstructed(request: Request, out: Path, progress: Progress) -> Path:
    """Return the file of the reconstructed cameras; those of other recordings are reconstructed again."""
    present = existing_dataset.present(out)
    known = {} if present is None else present.get("identity", {}).get("recordings", {})
    other = not unknown_cameras.fit(request.source, out, known)
    if other and present is not None and not request.overwrite:
        existing_dataset.check_replaceable(out, present, ["recordings"])
    return unknown_cameras.reconstruct(
        request.source,
        out,
        request.unknown,
        request.up,
        rate=request.rate,
        again=request.overwrite or other,
        progress=progress,
    )


def _known(out: Path, wanted: dict[str, Any], *, overwrite: bool) -> dict[str, Any] | None:
    """Return the record of a run with the identity, or None.

    Raises:
        DatasetError: The folder has a data set of another run, which must not be replaced.
    """
    present = existing_dataset.present(out)
    if present is None or present.get("identity") == wanted:
        return present
    if not overwrite:
        changed = [key for key in wanted if present.get("identity", {}).get(key) != wanted[key]]
        existing_dataset.check_replaceable(out, present, changed)
    return None


def _plan(
    request: Request, opened: list[Camera], calibration: Calibration, known: dict[str, Any] | None, progress: Progress
) -> Plan:
    sources = [camera.source for camera in opened]
    if known is not None:
        offsets, notes = record.offsets_of(known), list(known["notes"])
    else:
        calibrated = [camera.calibrated for camera in opened]
        offsets, notes = clocks.offsets(
            sources, calibration, calibrated, request.sync, request.offsets, progress, request.masks
        )
    names = [source.name for source in sources]
    times = [
        camera.source.times[camera.usable] + offset.seconds for camera, offset in zip(opened, offsets, strict=True)
    ]
    choice = frame_choice.choose(names, times, request.window)
    indices = tuple(camera.usable[index] for camera, index in zip(opened, choice.indices, strict=True))
    choice = frame_choice.replace_indices(choice, indices)
    if known is None:
        notes += _length_notes(names, choice) + _unused_notes(opened, calibration)
    timeline = data_splits.arrange(names, choice, request.hold_out)
    sizes = [(source.width, source.height) for source in sources]
    counts = [sum(split == "train" for split in splits) for splits in timeline.splits]
    size = image_size.choose(sizes, counts, request.lines if known is None else known["images"]["lines"])
    return Plan(request, tuple(opened), calibration, tuple(offsets), choice, timeline, size, tuple(notes))


def _length_notes(names: list[str], choice: Choice) -> list[str]:
    """Remarks about time that only some cameras recorded, one about its beginning and one about its end."""
    begins, ends = choice.spans.T
    notes = []
    for unused, word in ((begins.max() - begins, "begins later"), (ends - ends.min(), "ends earlier")):
        cut = np.flatnonzero(unused > max(2 * choice.source_interval, 0.1))
        if len(cut):
            cameras = _listed([names[k] for k in cut])
            notes.append(f"{cameras}: up to {unused.max():.2f} s are not used, because {names[unused.argmin()]} {word}")
    return notes


def _unused_notes(opened: list[Camera], calibration: Calibration) -> list[str]:
    """A remark about calibrated cameras that have no recording, if there are any."""
    used = {camera.calibrated.name for camera in opened}
    unused = [camera.name for camera in calibration.cameras if camera.name not in used]
    return [f"{_listed(unused)}: calibrated, but without a recording"] if unused else []


def _listed(names: list[str]) -> str:
    """Return the first names, and the number of the others."""
    others = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {others} more" if others > 0 else "")


def _with_lost(plan: Plan, lost: dict[str, list[int]]) -> Plan:
    """Return the plan with the frames that cannot be decoded, and a remark about each camera that has some."""
    cameras = []
    for camera, indices in zip(plan.cameras, plan.choice.indices, strict=True):
        if gone := lost[camera.name]:
            note = (
                f"{len(gone)} of {len(indices)} frames cannot be decoded and are left out, the first is frame {gone[0]}"
            )
            notes = (*camera.source.notes, f"{note}; copy the recording again")
            camera = replace(camera, source=replace(camera.source, notes=notes))
        cameras.append(camera)
    return replace(plan, cameras=tuple(cameras), lost=lost)


def _write_images(plan: Plan, out: Path, progress: Progress) -> dict[str, list[int]]:
    """Write the images that are missing. Returns indices of frames that cannot be decoded, by camera."""
    total, done, reported = sum(len(indices) for indices in plan.choice.indices), 0, 0
    write = images.write_png if plan.request.lossless else images.write_jpeg
    lost = {}
    for number, camera in enumerate(plan.cameras):
        indices = plan.choice.indices[number].tolist()
        paths = {index: out / (plan.image_name(number, index) + plan.suffix) for index in indices}
        missing = [index for index in indices if not paths[index].is_file()]
        done += len(indices) - len(missing)
        written = set()
        for index, pixels in camera.source.read(missing):
            write(paths[index], plan.rectifier(number, index).image(pixels))
            written.add(index)
            done += 1
            reported = done
            progress({"event": "images", "done": done, "total": total, "text": camera.name})
        gone = [index for index in missing if index not in written]
        done += len(gone)
        if len(gone) == len(indices):
            raise errors.DatasetError(
                f"{camera.source.paths[0]}: none of the {len(gone)} requested frames can be decoded; copy it again"
            )
        lost[camera.name] = gone
    if reported < total:
        progress({"event": "images", "done": total, "total": total, "text": plan.cameras[-1].name})
    return lost

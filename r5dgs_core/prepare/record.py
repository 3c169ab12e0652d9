"""Files of a prepared data set: the content of ``capture.json``, and the camera files."""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, atomic_files
from ..capture.calibration.calibration import Calibration
from ..data.layouts.camera_files import POINTS
from ..data.splits import SPLITS
from ..scene.cameras import OPENGL_TO_OPENCV
from . import capture_file, source_files
from .cameras import Camera
from .clock import GAP, Offset
from .plan import Plan, Request


def identity(request: Request, opened: Sequence[Camera], calibration: Calibration) -> dict[str, Any]:
    """Return the input and the settings that determine a data set. JSON types."""
    settings = {
        "start": request.window.start,
        "end": request.window.end,
        "every": request.window.every,
        "fps": request.window.fps,
        "size": request.lines,
        "lossless": request.lossless,
        "sync": request.sync,
        "offsets": dict(sorted(request.offsets.items())),
        "rate": request.rate,
        "hold_out_camera": list(request.hold_out.cameras),
        "hold_out_every": request.hold_out.every,
        "hold_out_after": request.hold_out.after,
        "horizon": request.hold_out.horizon,
        "scale": calibration.meters_per_unit,
    }
    files = {camera.name: source_files.fingerprint(camera.source.paths) for camera in opened}
    views = [
        (camera.name, view.lens, view.camera_to_world.tolist())
        for camera in opened
        for view in camera.frames or [camera.calibrated]
    ]
    times = hashlib.sha256(b"".join(camera.source.times.tobytes() for camera in opened)).hexdigest()
    cameras = hashlib.sha256((calibration.format + repr(views)).encode()).hexdigest()
    return {**settings, "recordings": files, "calibration": cameras, "times": times}


def content(
    plan: Plan, identity: dict[str, Any], *, finished: bool, lost: Mapping[str, list[int]] | None = None
) -> dict[str, Any]:
    """Return the content of ``capture.json``. JSON types."""
    unit = plan.calibration.meters_per_unit
    return {
        "generator": f"r5dgs {__version__}",
        "finished": finished,
        "source": str(plan.request.source),
        "identity": identity,
        "cameras": [_camera(plan, number, (lost or {})) for number in range(len(plan.cameras))],
        "calibration": {
            "format": plan.calibration.format,
            "file": plan.calibration.path.name,
            "meters_per_unit": unit,
            "world_convention": plan.calibration.world_convention,
        },
        "time": {
            "seconds_per_unit": plan.timeline.seconds_per_unit,
            "frames_per_unit": plan.timeline.frames_per_unit,
            "t_max": plan.timeline.t_max,
            "interval_ms": 1e3 * plan.choice.interval,
        },
        "images": {"lines": plan.size.lines, "kind": "PNG" if plan.request.lossless else "JPEG 95"},
        "notes": list(plan.notes),
        **({} if finished else {"image_files": _image_files(plan)}),
    }


def _image_files(plan: Plan) -> list[str]:
    """Paths of all images, by which files of others are told apart while the data set is unfinished."""
    chosen = enumerate(plan.choice.indices)
    return [plan.image_name(number, index) + plan.suffix for number, found in chosen for index in found.tolist()]


def _camera(plan: Plan, number: int, lost: Mapping[str, list[int]]) -> dict[str, Any]:
    source, offset = plan.cameras[number].source, plan.offsets[number]
    lens = plan.cameras[number].calibrated.lens
    steps = np.diff(source.times)
    interval = source.interval
    long = np.flatnonzero(steps > GAP * interval)
    return {
        "name": source.name,
        "files": [path.name for path in source.paths] if source.videos else [f"{len(source.paths)} frames"],
        "width": source.width,
        "height": source.height,
        "frames": len(source.times),
        "used": len(plan.choice.indices[number]) - len(lost.get(source.name, [])),
        "rate": 1.0 / interval,
        "times": source.timing,
        "gaps": [{"after_frame": int(k), "ms": 1e3 * float(steps[k])} for k in long[:100]],
        "offset_ms": 1e3 * offset.seconds,
        "offset_sigma_ms": None if offset.sigma is None else 1e3 * offset.sigma,
        "offset_from": offset.method,
        "lens": dataclasses.asdict(lens),
        "undecodable": lost.get(source.name, []),
        "notes": list(source.notes),
    }


def offsets_of(known: Mapping[str, Any]) -> list[Offset]:
    """Return the offsets that a record holds."""
    return [
        Offset(
            camera["offset_ms"] / 1e3,
            None if camera["offset_sigma_ms"] is None else camera["offset_sigma_ms"] / 1e3,
            camera["offset_from"],
        )
        for camera in known["cameras"]
    ]


def write_points(plan: Plan, out: Path) -> None:
    """Write the points of the reconstruction, from which training starts; remove those of another one."""
    path, points, colors = out / POINTS, plan.calibration.points, plan.calibration.colors
    if points is None or colors is None or len(points) == 0:
        path.unlink(missing_ok=True)
        return
    content = io.BytesIO()
    np.save(content, np.concatenate([points, colors], axis=1))
    atomic_files.write(path, content.getvalue())


def write_cameras(plan: Plan, out: Path, lost: Mapping[str, list[int]]) -> None:
    """Write the camera file of each split that has images, and remove those of empty splits."""
    for split in SPLITS:
        data = {}
        for number, camera in enumerate(plan.cameras):
            frames = _frames(plan, number, split, set(lost.get(camera.name, [])))
            if frames:
                first = int(plan.choice.indices[number][0])
                data[camera.name] = {**_lens(plan, number, first), **_shared_pose(camera), "frames": frames}
        path = out / f"transforms_{split}.json"
        if not data:
            path.unlink(missing_ok=True)
            continue
        top = {
            "world_convention": plan.calibration.world_convention,
            "frames_per_unit": plan.timeline.frames_per_unit,
            "seconds_per_unit": plan.timeline.seconds_per_unit,
            "meters_per_unit": plan.calibration.meters_per_unit,
        }
        capture_file.write_json(path, {**top, "data": data})


def _lens(plan: Plan, number: int, index: int) -> dict[str, float]:
    rectifier = plan.rectifier(number, index)
    k = rectifier.intrinsics
    lens = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": rectifier.width, "h": rectifier.height}
    return {key: value if isinstance(value, int) else float(value) for key, value in lens.items()}


def _shared_pose(camera: Camera) -> dict[str, Any]:
    return {} if camera.frames else {"transform_matrix": (camera.pose(0) @ OPENGL_TO_OPENCV).tolist()}


def _frames(plan: Plan, number: int, split: str, lost: set[int]) -> list[dict[str, Any]]:
    camera, found = plan.cameras[number], []
    indices = plan.choice.indices[number].tolist()
    shared = _lens(plan, number, indices[0]) if indices else {}
    rows = zip(
        indices,
        plan.timeline.times[number].tolist(),
        plan.timeline.splits[number],
        plan.choice.moments[number].tolist(),
        strict=True,
    )
    for index, t, own, moment in rows:
        if own == split and index not in lost:
            frame = {"file_path": plan.image_name(number, index) + plan.suffix, "time": t, "frame": moment}
            if camera.frames:
                frame |= {key: value for key, value in _lens(plan, number, index).items() if value != shared[key]}
                frame["transform_matrix"] = (camera.pose(index) @ OPENGL_TO_OPENCV).tolist()
            found.append(frame)
    return found

"""Cameras from image features: structure from motion on the static parts of all views, by COLMAP."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ... import errors, extras
from ...data import images
from ..calibration.calibration import CalibratedCamera, CalibratedFrame, Calibration
from ..calibration.formats import colmap
from ..calibration.lens import Lens
from . import recording as recordings_module
from .recording import Recording
from .request import Request

NEIGHBOURS = 8  # number of following frames with which a frame of a moving camera is matched
LINKS = 12  # frames of a moving camera that are matched with those of the other cameras
FEWEST_MATCHES = 20  # minimum number of matches that connects two images
_FOCAL_RANGE = 0.4, 3.0  # plausible focal lengths in widths of the image
_RADIAL_RANGE = 0.6  # largest plausible coefficient of radial distortion


def reconstruct(recordings: Sequence[Recording], request: Request, work: Path) -> Calibration:
    """Reconstruct cameras from features.

    Args:
        recordings: The cameras.
        request: Known facts about them.
        work: Folder for intermediate files; it is emptied.

    Returns:
        Lens and pose of every camera. The unit of the world is free, and its up is that of the cameras.

    Raises:
        DatasetError: Cameras cannot be connected; the error names them.
        BackendError: pycolmap is not installed, or fails.
    """
    with extras.required("reconstruction of cameras", "prepare"):
        import pycolmap  # noqa: F401
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    names = {recording.name: _write_images(recording, request, work) for recording in recordings}
    _write_pairs(names, work / "pairs.txt")
    lenses = {r.name: _colmap_lens(r, request.lenses[r.name]) for r in recordings if r.name in request.lenses}
    if lenses and len(lenses) < len(recordings):
        lenses = {}  # all are refined, or none
    sizes = {(recording.width, recording.height) for recording in recordings}
    if request.shared_lens and len(sizes) > 1:
        raise errors.DatasetError(f"a shared lens: expected videos of one size, found {sorted(sizes)}")
    wide = len(recordings) > len(request.moving)  # fixed cameras are far apart
    job = {"shared": request.shared_lens and not lenses, "lenses": lenses, "wide": wide}
    (work / "job.json").write_text(json.dumps(job), encoding="utf-8")
    _run(work)
    return _read(recordings, request, names, work)


def _write_images(recording: Recording, request: Request, work: Path) -> list[str]:
    """Write the images of a camera: one of the static parts, or all frames if it moves; returns their names."""
    if recording.name not in request.moving:
        still = recordings_module.still(recording)
        return [_write_image(work, f"{recording.name}/still.png", still.pixels, still.static)]
    everywhere = np.ones((recording.height, recording.width), bool)
    frames = recording.read(recordings_module.spread(len(recording.times), request.most_frames))
    return [_write_image(work, f"{recording.name}/{index:06d}.png", pixels, everywhere) for index, pixels in frames]


def _write_image(work: Path, name: str, pixels: np.ndarray, usable: np.ndarray) -> str:
    """Write an image and its mask as COLMAP expects them; returns the name of the image."""
    images.write_png(work / "images" / name, pixels)
    images.write_png(work / "masks" / f"{name}.png", usable.astype(np.uint8) * 255)
    return name


def _write_pairs(names: dict[str, list[str]], path: Path) -> None:
    """List the pairs of images to match: neighbours in time, and a few images of each camera with all others."""
    pairs = set()
    links = [
        name for files in names.values() for name in (files[k] for k in recordings_module.spread(len(files), LINKS))
    ]
    pairs |= {(a, b) for k, a in enumerate(links) for b in links[k + 1 :]}
    for files in names.values():
        pairs |= {(a, b) for k, a in enumerate(files) for b in files[k + 1 : k + 1 + NEIGHBOURS]}
    path.write_text("".join(f"{a} {b}\n" for a, b in sorted(pairs)), encoding="utf-8")


def _colmap_lens(recording: Recording, lens: Lens) -> dict:
    """Return a known lens as a camera of COLMAP."""
    focal = [lens.fx, lens.fy, lens.cx, lens.cy]
    if lens.model == "fisheye":
        model, parameters = "OPENCV_FISHEYE", [*focal, *lens.coefficients, *[0.0] * (4 - len(lens.coefficients))]
    elif lens.model in ("pinhole", "brown") and len(lens.coefficients) <= 8 and not lens.skew:
        model, parameters = "FULL_OPENCV", [*focal, *lens.coefficients, *[0.0] * (8 - len(lens.coefficients))]
    else:
        raise errors.DatasetError(
            f"camera {recording.name!r}: reconstruction with a known lens {lens.model} is not supported; leave it out"
        )
    return {"model": model, "width": recording.width, "height": recording.height, "parameters": parameters}


def _run(work: Path) -> None:
    module = f"{__package__}.colmap_process"
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(
        [sys.executable, "-m", module, str(work.resolve())], cwd=root, capture_output=True, text=True, check=False
    )
    (work / "colmap.log").write_text(done.stdout + done.stderr, encoding="utf-8")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise errors.BackendError(f"{work / 'colmap.log'}: COLMAP failed: {last[:300]}")


def _read(recordings: Sequence[Recording], request: Request, names: dict[str, list[str]], work: Path) -> Calibration:
    """Read the model, and check that it holds all cameras and that their lenses are plausible."""
    inliers = json.loads((work / "matches.json").read_text(encoding="utf-8"))
    if not (work / "sparse").is_dir():
        raise _unconnected([recording.name for recording in recordings], inliers)
    model = colmap.read(work / "sparse")
    frames = {
        f"{frame.path.parent.name}/{frame.path.name}": frame for camera in model.cameras for frame in camera.frames
    }
    lost = [name for name, files in names.items() if not any(file in frames for file in files)]
    if lost:
        raise _unconnected(lost, inliers)
    cameras = []
    for recording in recordings:
        found = [frames[file] for file in names[recording.name] if file in frames]
        _check_lens(recording, found[0].lens)
        moving = recording.name in request.moving
        shots = tuple(
            CalibratedFrame(f.path, float(recording.times[int(f.path.stem)]), f.lens, f.camera_to_world) for f in found
        ) if moving else ()  # fmt: skip
        size = recording.width, recording.height
        cameras.append(CalibratedCamera(recording.name, *size, found[0].lens, found[0].camera_to_world, shots))
    return Calibration(
        tuple(cameras), None, "features", work, seconds_per_time=1.0, points=model.points, colors=model.colors
    )


def _unconnected(lost: Sequence[str], inliers: list) -> errors.DatasetError:
    """Return the error for cameras that could not be connected, with the best match of each."""
    best: dict[str, tuple[int, str]] = {}  # most matches with an image of another camera
    for a, b, count in inliers:
        pair = a.partition("/")[0], b.partition("/")[0]
        for own, other in (pair, pair[::-1]) if pair[0] != pair[1] else ():
            best[own] = max(best.get(own, (0, "")), (count, other))
    weak = [name for name in lost if best.get(name, (0, ""))[0] < FEWEST_MATCHES]
    described = []
    for name in weak or lost:
        count, other = best.get(name, (0, ""))
        described.append(f"{name} ({count} matches at most, with {other})" if count else f"{name} (no match)")
    return errors.DatasetError(
        f"cameras {', '.join(described)}: cannot be connected to the others by image features. Remedy: film a ChArUco "
        "board that is carried slowly through the space that the cameras share, and name it with --board; film again "
        "with cameras closer together, or with printed pages or other textured, still things where views overlap; or "
        "give a calibration with --calibration"
    )


def _check_lens(recording: Recording, lens: Lens) -> None:
    """Raise DatasetError for a lens that only a wrong reconstruction can have."""
    focal = lens.fx / max(recording.width, recording.height)
    bent = max((abs(k) for k in lens.coefficients[:2]), default=0.0)
    if not _FOCAL_RANGE[0] <= focal <= _FOCAL_RANGE[1] or bent > _RADIAL_RANGE:
        raise errors.DatasetError(
            f"camera {recording.name!r}: the reconstruction is wrong (focal length {focal:.2g} widths, distortion "
            f"{bent:.2g}). Remedy: give the lenses with --lenses, name --shared-lens if it is true, film a ChArUco "
            "board and name it with --board, or give a calibration with --calibration"
        )

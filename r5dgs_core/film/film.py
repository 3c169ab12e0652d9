"""Films of scenes: a video, a picture or a folder of frames from settings."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files, errors, folder_lock
from ..data import dataset as datasets
from ..data import images, memory
from ..scene import spherical_harmonics
from ..scene.scene import Scene
from . import frame_folder, frame_renderer, multilayer, schedule, side_by_side, video
from .schedule import Schedule, Shot
from .settings import Settings

Progress = Callable[[dict[str, Any]], None]
_SINGLE = ("out", "frames", "share", "overwrite")  # settings in which processes that share a folder may differ


@dataclass(frozen=True)
class Result:
    """Files of a film.

    Attributes:
        paths: Files that this process has written.
        others: Number of frames that existed before or were drawn by other processes.
    """

    paths: tuple[Path, ...]
    others: int = 0


def write(
    scene: Scene,
    settings: Settings,
    *,
    file: Path | None = None,
    shown: Collection[int] | None = None,
    hidden: Collection[int] | None = None,
    dataset: datasets.Dataset | None = None,
    progress: Progress = lambda event: None,
) -> Result:
    """Render a film and write it.

    Args:
        scene: The scene.
        settings: Settings that passed `settings.check`.
        file: File of the scene, whose content tells apart the frames of a folder; only folders need it.
        shown: Ids of the objects to show; None for all.
        hidden: Ids of the objects to leave out with their shadows, or None.
        dataset: Data set whose images are shown beside the picture, relative to the scene's origin, or None.
        progress: Receives an event per frame.

    Raises:
        ConfigError: Nothing is selected, a camera does not exist, a time is before the first observed one, or a file
            exists or cannot be written.
        BackendError: An encoder is missing.
    """
    rows = _rows(scene, shown, hidden)
    plan = schedule.make(scene, settings)
    _check_memory(settings, plan)
    film = _Film(scene, settings, plan, rows, dataset)
    if settings.is_folder:
        if file is None:
            raise ValueError("file: frames in a folder need the file of the scene")
        return _write_folder(film, _key(settings, file, rows, dataset), progress)
    if settings.out.exists() and not settings.overwrite:
        raise errors.ConfigError(
            f"{settings.out}: the file exists; replace it with --overwrite, or choose another name"
        )
    with _locked(settings.out):
        _write_file(film, progress)
    return Result((settings.out,))


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Lock an output file for the block, and remove what killed processes left of it. Raises ConfigError."""
    with folder_lock.try_file(out.with_name(f".{out.name}.placeholder")) as held:
        if not held:
            raise errors.ConfigError(f"{out}: another process writes this file; wait for it, or choose another name")
        for path in atomic_files.leftovers_by_name(out):
            path.unlink(missing_ok=True)
        yield


def _write_file(film: _Film, progress: Progress) -> None:
    """Write a video or a picture."""
    settings, plan = film.settings, film.plan
    if settings.is_video:
        with video.writing(settings.out, plan.fps, alpha=settings.transparent) as append:
            for shot in plan.shots:
                append(film.picture(shot))
                progress(_event(shot.number, len(plan.shots)))
    else:
        film.draw(plan.shots[0], settings.out)
        progress(_event(1, 1))


def _write_folder(film: _Film, key: dict[str, str], progress: Progress) -> Result:
    """Write frames to a folder."""
    settings, folder = film.settings, film.settings.out
    shots = film.plan.shots
    if settings.frames is not None:
        first, last = settings.frames
        shots = tuple(shot for shot in shots if first <= shot.number <= last)
        if not shots:
            raise errors.ConfigError(f"--frames {first}:{last}: the film has the frames 1 to {len(film.plan.shots)}")
    frame_folder.create(folder)
    frame_folder.claim(folder, key, overwrite=settings.overwrite)
    present = [path for shot in shots if (path := frame_folder.path_of(folder, shot.number, settings.suffix)).exists()]
    if present and not (settings.overwrite or settings.share):
        raise errors.ConfigError(
            f"{present[0]}: the file exists; draw only missing frames with --share, or replace all with --overwrite"
        )
    written: list[Path] = []
    filled = frame_folder.fill(folder, shots, settings.suffix, film.draw, share=settings.share)
    for done, (shot, drawn) in enumerate(filled, 1):
        if drawn:
            written.append(frame_folder.path_of(folder, shot.number, settings.suffix))
        progress({**_event(done, len(shots)), "frame": shot.number, "drawn": drawn})
    return Result(tuple(written), len(shots) - len(written))


class _Film:
    """A scene with settings and schedule: draws single frames."""

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        plan: Schedule,
        rows: np.ndarray | None,
        dataset: datasets.Dataset | None,
    ):
        self.scene, self.settings, self.plan = scene, settings, plan
        options = {"rows": rows, "samples": settings.samples, "transparent": settings.transparent}
        self._renderer = frame_renderer.FrameRenderer(scene, settings.mode, **options)
        self._captured = None
        if dataset is not None:
            background = np.clip(spherical_harmonics.dc_to_rgb(scene.background_sh[0]), 0, 1)
            self._captured = side_by_side.CapturedImages(dataset, plan.shots[0].camera.name, background)

    def picture(self, shot: Shot) -> np.ndarray:
        """Return the pixels of a frame of a video or PNG. [H, W, 3 or 4]"""
        pixels = self._renderer.picture(shot.camera, shot.t)
        pixels = np.clip(pixels if self.settings.transparent else pixels[..., :3], 0, 1)
        if self._captured is not None:
            pixels = side_by_side.joined([self._captured.at(shot), pixels])
        if self.settings.marker:
            from . import time_marker  # imports matplotlib, which a plain picture does not need

            pixels = time_marker.draw(pixels, shot.t, self.scene.t_max, self.plan.span)
        return pixels

    def draw(self, shot: Shot, path: Path) -> None:
        """Write a frame as PNG or EXR, atomically."""
        try:
            if path.suffix.lower() == ".png":
                images.write_png(path, self.picture(shot))
                return
            layers = self._renderer.layers(shot.camera, shot.t) if self.settings.passes else None
            picture = self._renderer.picture(shot.camera, shot.t)
            multilayer.write(path, multilayer.channels(self.scene, picture, layers, self.settings.passes), self.scene)
        except errors.DatasetError as error:
            raise errors.ConfigError(str(error)) from error


def _check_memory(settings: Settings, plan: Schedule) -> None:
    """Raise ConfigError if drawing a frame needs more than the available memory."""
    width, height = plan.shots[0].camera.width, plan.shots[0].camera.height
    needed = frame_renderer.memory(width, height, samples=settings.samples, layers=bool(settings.passes))
    free = memory.available()
    if free is not None and needed > free:
        raise errors.ConfigError(
            f"--size {width}x{height} with --samples {settings.samples}: a picture needs {needed / memory.GB:.1f} GB "
            f"of memory, {free / memory.GB:.1f} GB are available; choose a smaller size or fewer samples"
        )


def _rows(scene: Scene, shown: Collection[int] | None, hidden: Collection[int] | None) -> np.ndarray | None:
    """Return the Gaussians to draw. Raises ConfigError if there are none."""
    rows = frame_renderer.rows_of(scene, shown, hidden)
    empty = [item.name for item in scene.objects if shown is not None and item.id in shown and item.count == 0]
    if (rows is not None and len(rows) == 0) or not len(scene.gaussians.means):
        reason = f"{', '.join(empty)}: no Gaussians" if empty else "no Gaussians are left"
        raise errors.ConfigError(f"{reason}, so there is nothing to draw; choose other objects")
    return rows


def _key(settings: Settings, file: Path, rows: np.ndarray | None, dataset: datasets.Dataset | None) -> dict[str, str]:
    """Return everything that determines the frames of a folder, with hashes of contents."""
    key = {name: repr(value) for name, value in dataclasses.asdict(settings).items() if name not in _SINGLE}
    paths = [Path(name) for name in settings.camera if name.lower().endswith(".json")]
    return {
        "scene": _digest(file.read_bytes()),
        **key,
        "camera_path": " ".join(_digest(path.read_bytes()) for path in paths if path.is_file()),
        "gaussians": "all" if rows is None else _digest(rows.tobytes()),
        "beside": "" if dataset is None else dataset.digest,
    }


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _event(done: int, total: int) -> dict[str, Any]:
    return {"event": "render", "done": done, "total": total, "unit": "frames"}

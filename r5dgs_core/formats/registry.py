"""Export formats, shared by ``r5dgs export`` and Blender, with the parts of a scene that each keeps and loses."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .. import errors, extras

if TYPE_CHECKING:
    from ..scene.scene import Scene

MODULES = {  # module of this room that defines `FORMAT`, by the name of the format
    "ply": "ply",
    "cameras": "camera_files",
    "r5dgs": "quantised_scene",
    "glb": "glb",
    "html": "html",
    "usd": "usd",
    "4dgs": "fourdgs_file",
    "spz": "spz",
    "sog": "sog",
    "poses": "poses",
    "poses_csv": "poses_csv",
    "tum": "tum",
    "hulls": "hulls",
    "mjcf": "mjcf",
    "urdf": "urdf",
}


@dataclass(frozen=True)
class Options:
    """Part of a scene to export.

    Attributes:
        times: Scene times, at least one.
        frames: Frame number of each time; None for a single time without a number.
        object_ids: Objects to export; None for all.
        until: Last scene time of formats with motion; None for the time up to which Blender extrapolates by default.
        still: PNG of the scene at t_max for formats with a picture, or None.
        plain: True to leave out columns that other programs do not know.
    """

    times: tuple[float, ...]
    frames: tuple[int, ...] | None = None
    object_ids: frozenset[int] | None = None
    until: float | None = None
    still: bytes | None = None
    plain: bool = False


@dataclass(frozen=True)
class Format:
    """An export format.

    Attributes:
        name: Name on the command line.
        label: Name in Blender's menus.
        suffix: Suffix of its files, with the dot.
        keeps: Parts of a scene that a file holds.
        loses: Parts of a scene that a file does not hold.
        write: Writes a scene and yields the path of each file when it is complete. Files are replaced atomically.
        per_frame: True if each frame is a file of its own.
        has_times: True if a file holds all of `Options.times`.
        parts: Returns names of the files if a scene is written to several, such as one for each object, or None.
        companions: Returns ends of the names of files that are written before and beside the others, or None.
        has_objects: True if a file holds objects, so that `Options.object_ids` applies.
        has_motion: True if a file holds the motion up to `Options.until`; `Options.times` then do not apply.
        has_still: True if a file holds `Options.still`.
        whole: True if a file holds the scene at all times, so that `Options.times` and `Options.until` do not apply.
        has_columns: True if files have columns of our own, so that `Options.plain` applies.
        losses: Returns sentences about what a file loses of the exported objects.
        extra: Extra of ``pip install r5dgs[extra]`` that it needs, or None.
        packages: Packages of the extra that `write` imports.
        program: Program that `write` runs, or None.
        remedy: Command that installs the program.
    """

    name: str
    label: str
    suffix: str
    keeps: str
    loses: str
    write: Callable[[Scene, Path, Options], Iterator[Path]]
    per_frame: bool = False
    has_times: bool = False
    parts: Callable[[Scene, Options], list[str]] | None = None
    companions: Callable[[Scene, Options], list[str]] | None = None
    has_objects: bool = True
    has_motion: bool = False
    has_still: bool = False
    whole: bool = False
    has_columns: bool = False
    losses: Callable[[Scene, Options], list[str]] = lambda scene, options: []
    extra: str | None = None
    packages: tuple[str, ...] = ()
    program: str | None = None
    remedy: str = ""

    @property
    def summary(self) -> str:
        """Text of a tooltip: the kept and the lost parts of a scene."""
        return f"Keeps: {self.keeps}. Not kept: {self.loses}"

    def why_unavailable(self) -> str | None:
        """Return the reason and the remedy if this Python cannot write the format, else None."""
        if self.program is not None and shutil.which(self.program) is None:
            return f"{self.label} ({self.suffix}): {self.program} is not installed; remedy: {self.remedy}"
        missing = [name for name in self.packages if importlib.util.find_spec(name) is None]
        if not missing:
            return None
        return (
            f"{self.label} ({self.suffix}): {', '.join(missing)} is not installed; remedy: "
            f"{extras.command(str(self.extra))}"
        )

    def paths(self, path: Path, options: Options, scene: Scene) -> list[Path]:
        """Return the files that `write` makes."""
        if self.parts is not None:
            return [path.with_name(f"{path.stem}_{part}{path.suffix}") for part in self.parts(scene, options)]
        ends = [] if self.companions is None else self.companions(scene, options)
        beside = [path.with_name(f"{path.stem}_{end}") for end in ends]
        if not self.per_frame or options.frames is None:
            return [*beside, path]
        return [*beside, *(numbered(path, frame) for frame in options.frames)]


def get(name: str) -> Format:
    """Return a format by its name. Raises KeyError for an unknown name."""
    return importlib.import_module(f".{MODULES[name]}", __package__).FORMAT


def usable(name: str) -> Format:
    """Return a format that this Python can write. Raises KeyError for an unknown name, BackendError if it cannot."""
    found = get(name)
    if (reason := found.why_unavailable()) is not None:
        raise errors.BackendError(reason)
    return found


def usable_names() -> list[str]:
    """Names of the formats that this Python can write."""
    return [name for name in MODULES if get(name).why_unavailable() is None]


def numbered(path: Path, frame: int) -> Path:
    """Insert a frame number into a path: scene.ply -> scene_0012.ply."""
    return path.with_name(f"{path.stem}_{frame:04d}{path.suffix}")


@contextlib.contextmanager
def writing(path: Path, also: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Convert an OSError of the block to a SceneFileError that names the file.

    Args:
        path: The file.
        also: Further exception types that a library raises if it cannot write.

    Raises:
        SceneFileError: The block raises OSError, or one of ``also``.
    """
    try:
        yield
    except (OSError, *also) as error:
        reason = getattr(error, "strerror", None) or error  # without the name of the temporary file
        raise errors.SceneFileError(f"{path}: cannot be written: {reason}") from error

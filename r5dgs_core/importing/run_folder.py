"""Run folders of 3DGS and its descendants: detection of the layout, iterations and settings.

All layouts have ``point_cloud/iteration_N/point_cloud.ply``, and most have ``cfg_args``. Gaussian Grouping adds
``classifier.pth`` beside the PLY; Deformable-3DGS adds ``deform/iteration_N/deform.pth``; TRACE and FreeGave add
``vel.pth`` (and ``code_field.pth``) beside it.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import input_paths
from ..errors import CheckpointError
from ..scene.model_checks import MAX_TIME

KINDS = ("3dgs", "gaussian_grouping", "deformable_3dgs", "trace", "freegave")
TITLES: dict[str, str] = dict(
    zip(KINDS, ("3D Gaussian Splatting", "Gaussian Grouping", "Deformable-3DGS", "TRACE", "FreeGave"), strict=True)
)
_MAX_BYTES = 1 << 20  # limit on reading cfg_args
_KNOWN = f"known are the run folders of {', '.join(TITLES.values())}"


@dataclass(frozen=True)
class RunFolder:
    """Run folder of another project.

    Attributes:
        folder: The folder.
        iteration: Selected iteration.
        config: Settings of ``cfg_args``; empty without that file.
        deforms: True if there is a deformation network.
        files: Names of the weight files.
    """

    folder: Path
    iteration: int
    config: dict[str, Any]
    deforms: bool
    files: frozenset[str]

    @property
    def ply(self) -> Path:
        """Path of the Gaussians."""
        return self.folder / "point_cloud" / f"iteration_{self.iteration}" / "point_cloud.ply"

    def weights(self, name: str) -> Path:
        """Path of a weight file, "classifier.pth" or one of the deformation's."""
        part = "deform" if self.deforms else "point_cloud"
        return self.folder / part / f"iteration_{self.iteration}" / name

    def max_time(self) -> float:
        """Return the last time of the deformation of TRACE and FreeGave.

        Raises:
            CheckpointError: ``cfg_args`` does not contain it.
        """
        value = self.config.get("max_time")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_TIME:
            found = f"{value!r:.60}" if "max_time" in self.config else "nothing"
            raise CheckpointError(
                f"{self.folder / 'cfg_args'}: 'max_time': expected the last time of the deformation, found {found}; "
                "give it with --t-max (the default of both codes is 0.7)"
            )
        return float(value)


def open_run(folder: Path, iteration: int | None = None) -> RunFolder:
    """Inspect a run folder.

    Args:
        folder: The folder given to the training as ``--model_path``.
        iteration: Iteration to read; None for the last.

    Raises:
        CheckpointError: The layout is unknown, or the iteration is missing.
    """
    folder = Path(folder)
    input_paths.check_foreign_run(folder)
    if not (folder / "point_cloud").is_dir():
        remedy = ""
        for parent in folder.absolute().parents[:3]:
            if (parent / "point_cloud").is_dir():
                remedy = f"; name the run folder itself, {parent}"
                break
        raise CheckpointError(f"{folder}: expected a folder 'point_cloud', found none{remedy}; {_KNOWN}")
    there = _iterations(folder / "point_cloud", "point_cloud.ply")
    deforms = (folder / "deform").is_dir()
    if deforms:
        there &= _iterations(folder / "deform", "deform.pth")
    wanted = "point_cloud/iteration_N/point_cloud.ply" + " and deform/iteration_N/deform.pth" * deforms
    if not there:
        raise CheckpointError(f"{folder}: expected {wanted} of one iteration N, found none; is the run complete?")
    chosen = max(there) if iteration is None else iteration
    if chosen not in there:
        listed = ", ".join(map(str, sorted(there)))
        raise CheckpointError(f"{folder}: expected {wanted} for N = {chosen}, found the iterations {listed}")
    part = folder / ("deform" if deforms else "point_cloud") / f"iteration_{chosen}"
    files = frozenset(path.name for path in part.glob("*.pth"))
    known = {"deform.pth", "vel.pth", "code_field.pth"} if deforms else {"classifier.pth"}
    if files - known:
        raise CheckpointError(f"{part}: unknown layout: unexpected {', '.join(sorted(files - known))}; {_KNOWN}")
    return RunFolder(folder, chosen, read_config(folder / "cfg_args"), deforms, files)


def read_config(path: Path) -> dict[str, Any]:
    """Parse ``cfg_args``, the text ``Namespace(key=value, ...)``, without executing it; returns {} if it is missing.

    Values that are not literals (a device, a path object) are kept as text.
    """
    if not path.exists():
        return {}
    try:
        with open(path, "rb") as stream:
            text = stream.read(_MAX_BYTES).decode("utf-8").strip()
        call = ast.parse(text, mode="eval").body
    except (OSError, SyntaxError, ValueError, MemoryError, RecursionError) as error:
        raise CheckpointError(f"{path}: expected 'Namespace(key=value, ...)', cannot be read ({error})") from error
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
        raise CheckpointError(f"{path}: expected 'Namespace(key=value, ...)', found {text[:40]!r}")
    config: dict[str, Any] = {}
    for keyword in call.keywords:
        if keyword.arg is None:
            continue
        try:
            config[keyword.arg] = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            config[keyword.arg] = ast.get_source_segment(text, keyword.value) or ""
    return config


def _iterations(folder: Path, file: str) -> set[int]:
    """Numbers of the folders ``iteration_N`` that contain a file."""
    found = set()
    for path in folder.glob("iteration_*"):
        number = path.name.removeprefix("iteration_")
        if number.isdecimal() and (path / file).is_file():
            found.add(int(number))
    return found

"""`r5dgs check`: all faults of a data set, scene file, run folder, PLY file or configuration.

The rules are those of the readers, which continue after a fault here (`findings.Collector`). Warnings cover valid input
that is probably a mistake.
"""

from __future__ import annotations

from pathlib import Path

from .. import errors, findings, input_paths
from ..findings import Collector, Finding
from .codes import CODES


def check(path: Path, pictures: Path | None = None) -> list[Finding]:
    """Return all faults of a file or folder, errors first.

    Args:
        path: A data set, run folder, scene file, PLY file or TOML configuration.
        pictures: Folder for pictures of faults of a capture. If it is None, pictures of a data set that `r5dgs prepare`
            wrote go to its folder ``check``, and those of others are not drawn.

    Raises:
        ConfigError: The path does not exist, or its kind cannot be checked.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise errors.ConfigError(f"{path}: expected a file or folder, found nothing; check the path")
        found = _check_folder(path, pictures) if path.is_dir() else _check_file(path)
    except OSError as error:
        raise errors.ConfigError(f"{path}: cannot be read ({error})") from error
    return sorted(found, key=lambda finding: finding.severity != findings.ERROR)


def _check_folder(path: Path, pictures: Path | None) -> list[Finding]:
    if (path / input_paths.RUN_FILE).exists():
        from . import run

        return run.check(path, pictures)
    from ..prepare import capture_file
    from . import data

    if pictures is None and (path / capture_file.FILE).exists():
        pictures = path / "check"
        for earlier in pictures.glob("D[67][0-9]*.png"):  # their faults may be corrected
            earlier.unlink(missing_ok=True)
    return data.check(path, pictures=pictures)


def _check_file(path: Path) -> list[Finding]:
    suffix = path.suffix.lower()
    if suffix == input_paths.SCENE_SUFFIX:
        from . import scene

        return scene.check(path)
    if suffix == ".ply":
        from ..formats import ply

        collect = Collector(CODES, "P01")
        with collect():
            ply.read(path, collect)
        return collect.findings
    if suffix == ".toml":
        from ..config import config

        collect = Collector(CODES, "C01")
        with collect():
            config.load(path, guard=collect)
        return collect.findings
    raise errors.ConfigError(
        f"{path}: expected a data set, run folder, .r5dgs, .ply or .toml file, found another kind of file"
    )

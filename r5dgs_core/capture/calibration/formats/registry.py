"""Registry of the calibration formats, and detection of the format of a path."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

# Modules of this folder; the first that detects its files reads the path.
MODULES = (
    *(
        "r5dgs_json",
        "caliscope",
        "pose2sim",
        "anipose",
        "qualisys",
        "opencv_yaml",
        "panoptic",
        "nerfies",
        "nerfstudio",
        "llff",
    ),
    "colmap",
)


def find(path: Path) -> tuple[ModuleType, Path] | None:
    """Return the module of a path's format and the file or folder that it reads, or None.

    A module has ``FILES``, the names of its files for messages, ``detect(path) -> Path | None``, which only looks for
    files, and ``read(path) -> Calibration``.
    """
    for name in MODULES:
        module = _module(name)
        found = module.detect(path)
        if found is not None:
            return module, found
    return None


def known_files() -> str:
    """List the files of all formats, for messages."""
    return ", ".join(f"{_module(name).FILES} ({name})" for name in MODULES)


def _module(name: str) -> ModuleType:
    return importlib.import_module(f".{name}", __package__)

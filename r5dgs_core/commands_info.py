"""The command ``r5dgs info``: a summary of a scene file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from . import input_paths, terminal


def run_info(path: Path, *, as_json: bool) -> None:
    """Say what is in a scene file."""
    input_paths.check_scene(path)
    from .scene import scene_file

    found = scene_file.info(scene_file.read(path))
    if as_json:
        print(json.dumps(found, indent=2))
        return
    for key, value in found.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            print(f"{key}:")
            for row in value:
                print(
                    "  "
                    + "  ".join(f"{name}={_short(item)}" for name, item in row.items() if item not in ("", [], None))
                )
        else:
            print(f"{key}: {_short(value)}")


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else terminal.printable(str(value))

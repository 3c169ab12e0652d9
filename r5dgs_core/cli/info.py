"""The command ``r5dgs info``: print a summary of a scene file."""

from __future__ import annotations

import json
from pathlib import Path

from .. import input_paths, terminal


def run_info(path: Path, *, with_needs: bool = False, as_json: bool = False) -> None:
    """Print a summary of a scene file.

    Args:
    path: The scene file.
    with_needs: Also print the table of the scene's needs.
    as_json: Print all data of the scene as JSON instead.
    """
    input_paths.check_scene(path)
    from ..playback import scene_info
    from ..scene import scene_file

    scene = scene_file.read(path)
    if as_json:
        print(json.dumps(scene_info.info(scene), indent=2))
        return
    from ..evaluation import scene_summary

    print(scene_summary.summary(scene, path))
    if with_needs:
        from ..evaluation import evaluation_table

        terminal.console().print(evaluation_table.needs(scene.needs))

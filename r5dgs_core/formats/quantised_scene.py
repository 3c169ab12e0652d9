"""Scene files with quantised arrays, half as large as those that ``r5dgs bake`` writes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .. import errors
from ..scene import scene_file
from ..scene.scene import Scene
from . import registry


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write a whole scene, whatever the times of the options.

    Raises:
        ConfigError: The options select objects; the file holds all.
        SceneFileError: The file cannot be written.
    """
    if options.object_ids is not None:
        raise errors.ConfigError(f"{path}: expected no selection of objects, because scene files hold all")
    yield scene_file.write(scene, path, precision="quantised")


FORMAT = registry.Format(
    name="r5dgs",
    label="Quantised Scene",
    suffix=".r5dgs",
    keeps="the scene with all its parts (quantised)",
    loses="the precision of the scene file",
    write=export,
    has_objects=False,
    whole=True,
)

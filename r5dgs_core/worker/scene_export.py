"""Export of a scene file in any format of the registry, for a Blender whose Python lacks the format's package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .. import errors
from ..formats import registry
from ..protocol import fields
from ..scene import scene_file


def write(request: dict[str, Any]) -> list[str]:
    """Write the ``scene`` file in a ``format`` to ``path``, and return the paths of the files.

    ``times`` and ``frames``, the numbers of the frames or null, are those of `registry.Options`.

    Raises:
        ConfigError: A field is invalid, or nothing can be exported.
        BackendError: This Python lacks the format's package or program.
        SceneFileError: The scene cannot be read, or a file cannot be written.
    """
    name = fields.need(request, "format", str)
    if name not in registry.MODULES:
        raise errors.ConfigError(f"worker: unknown format {name!r:.60}; known are {', '.join(registry.MODULES)}")
    format = registry.usable(name)
    source, target = (fields.path_of(request.get(key), "export") for key in ("scene", "path"))
    times, frames = fields.times_of(request)
    fields.stamp_of(source)
    return [
        str(path) for path in format.write(scene_file.read(Path(source)), Path(target), registry.Options(times, frames))
    ]

"""Scenes as one self-contained web page: the player of `player/` with a glTF file inside."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Iterator
from pathlib import Path

from .. import atomic_files
from ..scene.scene import Scene
from . import glb, gltf, registry

PAGE = Path(__file__).with_name("player.html")  # made by player/build.mjs
NO_STILL = "data:,"
NO_PICTURE = "the picture for browsers without WebGL"
_PLACES = re.compile(r"\{\{(TITLE|STILL|SCENE)\}\}")


def page(scene: Scene, options: registry.Options) -> bytes:
    """Content of a page. Raises ConfigError if no Gaussian is selected."""
    content, arrays = glb.build(scene, options)
    stream = io.BytesIO()
    gltf.write(stream, content, arrays)
    picture = NO_STILL if options.still is None else f"data:image/png;base64,{_text(options.still)}"
    parts = {"TITLE": html.escape(scene.name), "STILL": picture, "SCENE": _text(stream.getvalue())}
    template = PAGE.read_text(encoding="utf-8")
    return _PLACES.sub(lambda place: parts[place[1]], template).encode()


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write a page. Implements `registry.Format.write`."""
    content = page(scene, options)
    with registry.writing(path):
        atomic_files.write(path, content)
    yield path


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that the player does not show, as sentences."""
    found = [sentence for sentence in glb.losses(scene, options) if not sentence.endswith(glb.ELSEWHERE)]
    return found if options.still is not None else [*found, NO_PICTURE]


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


FORMAT = registry.Format(
    name="html",
    label="Web Page",
    suffix=".html",
    keeps="the scene as glTF with a player: objects, motion, shading, names and stored words, cameras, bands",
    loses="bending of Gaussians, identity encodings, embeddings, needs table, provenance",
    write=export,
    has_motion=True,
    has_still=True,
    losses=losses,
)

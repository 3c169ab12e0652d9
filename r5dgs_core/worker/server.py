"""Worker process of the Blender extension: ``python -m r5dgs_core.worker.server``.

Requests are JSON lines on standard input. Each response is one JSON line on standard output, followed by the raw bytes
of the arrays that the line announces, in order:

    -> {"id": 1, "command": "render", ...}
    <- {"id": 1, "ok": true, "result": {...}, "arrays": [{"name": "color", "dtype": "<f4", "shape": [H, W, 3]}]} + bytes
    <- {"id": 1, "ok": false, "error": {"kind": "SceneFileError", "message": "..."}}

The scenes of the last ``load`` stay in memory. The worker exits at the end of its input. The rasterizer is imported
after the first response, so that ``hello`` can report missing packages, and torch only for encoders. Kernels are then
loaded in a background thread; render requests block until it finishes. If kernels have to be compiled, events without
an id are sent between responses:

    <- {"event": "compiling", "text": "rasterizer: compiling ...", "arrays": []}
    <- {"event": "progress", "text": "static layer", "step": 2, "steps": 5, "arrays": []}
    <- {"event": "ready", "seconds": 7.9, "arrays": []}
    <- {"event": "failed", "text": "LoweringError: ...", "arrays": []}     (instead of "ready")
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import os
import platform
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from .. import __version__, errors, timing
from ..formats import registry as formats
from ..language import query
from ..language.encoders import encoder_base, registry
from ..playback import scene_player
from ..protocol import answers as wire
from ..protocol import fields, messages
from ..render import posed_scene
from ..scene import quality, scene_file
from ..scene.scene import Scene
from . import edited_points, further_layers, scene_export
from .warming import WarmUpThread

if TYPE_CHECKING:
    from ..render.incremental_renderer import IncrementalRenderer

NEEDED = ("numba",)

Answer = tuple[dict[str, Any], dict[str, np.ndarray]]


class Server:
    """Request handler that holds the scenes of the last ``load``.

    Args:
        warming: Thread to wait for before the first picture.
    """

    def __init__(self, warming: WarmUpThread | None = None) -> None:
        self._warming = warming
        self._scenes: dict[tuple[str, int, int], Scene] = {}  # by path, time and size of the file; in load order
        self._failed: dict[tuple[str, int, int], str] = {}  # stamp and error of the last unreadable file
        self._points = edited_points.EditedPoints()
        self._stage: IncrementalRenderer | None = None  # renderer of `_staged`, created with the first image
        self._staged: list[Scene] = []  # the scenes, extended by edited points
        self._numbers: list[int] = []  # scene number of each path of the last load
        self._errors: list[quality.Quality] = []  # known error of each scene
        self._players: dict[int, scene_player.Player] = {}  # by scene number, created on first playback
        self._encoder: tuple[str, encoder_base.Encoder] | None = None  # the last encoder, with its path or "text"
        self._commands: dict[str, Callable[[dict[str, Any]], Answer]] = {
            "hello": self._hello,
            "load": self._load,
            "points": self._keep_points,
            "render": self._render,
            "query": self._query,
            "embed": self._embed,
            "export": self._export,
            "contact": self._contact,
            "warm_up": self._warm_up,
            "check": self._check,
        }

    def answer(self, request: dict[str, Any]) -> Answer:
        """Answer one request.

        Args:
            request: ``command`` and its fields.

        Returns:
            The result as JSON values, and arrays by name.

        Raises:
            R5dgsError: The request is invalid or cannot be fulfilled.
        """
        return self._commands[fields.command_of(request)](request)

    def _hello(self, _: dict[str, Any]) -> Answer:
        missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
        python, pid = platform.python_version(), os.getpid()
        able = {"formats": formats.usable_names(), "contact": importlib.util.find_spec("mujoco") is not None}
        return {"protocol": messages.VERSION, "python": python, "missing": missing, "pid": pid, **able}, {}

    def _load(self, request: dict[str, Any]) -> Answer:
        """Load the scene files ``paths`` in this order; keeps those already loaded and drops all others."""
        paths = fields.need(request, "paths", list)
        named = [fields.stamp_of(path) for path in paths]
        stamps = list(dict.fromkeys(named))  # read a repeated file once
        if stamps != list(self._scenes):
            known, self._scenes, self._numbers, self._stage, self._players = self._scenes, {}, [], None, {}
            known = {stamp: scene for stamp, scene in known.items() if stamp in stamps}  # free memory before reading
            found = {stamp: known.get(stamp) or self._read(stamp) for stamp in stamps}
            self._errors = [quality.measure(scene, Path(stamp[0])) for stamp, scene in found.items()]
            self._scenes = found
        self._numbers = [stamps.index(stamp) for stamp in named]
        scenes = [list(self._scenes.values())[number] for number in self._numbers]
        return {"scenes": [{"name": scene.name, "gaussians": len(scene.gaussians.means)} for scene in scenes]}, {}

    def _read(self, stamp: tuple[str, int, int]) -> Scene:
        """Read a scene file; the last unreadable file is not tried again until it changes, as viewports retry often."""
        if stamp not in self._failed:
            try:
                return scene_file.read(Path(stamp[0]))
            except errors.SceneFileError as error:
                if isinstance(error.__cause__, PermissionError):  # may be resolved without a change of the file
                    raise
                self._failed = {stamp: str(error)}
        raise errors.SceneFileError(self._failed[stamp])

    def _keep_points(self, request: dict[str, Any]) -> Answer:
        """Keep point edits; see `edited_points.EditedPoints.keep`."""
        self._points.keep(request)
        return {}, {}

    def _render(self, request: dict[str, Any]) -> Answer:
        """Rasterize the loaded scenes, as instances or by playback; the fields are those of `RenderRequest`."""
        scenes = self._loaded()
        wanted = messages.RenderRequest.from_json(request, self._numbers)
        ranks = 0 if wanted.coverage is None else wanted.coverage.ranks
        fields.check_size(wanted.camera, 0, ranks)
        self._wait_for_kernels()
        watch = timing.Stopwatch()
        instances = []
        if wanted.t is None:
            scenes, places = self._points.extend(scenes, edited_points.wanted(wanted))
            instances = edited_points.placed(wanted, places)
            fields.check_rows(instances, [len(scene.gaussians.means) for scene in scenes])
            fields.check_size(wanted.camera, sum(instance.count for instance in instances), ranks)
        added: dict[str, np.ndarray] = {}
        try:
            if wanted.t is None:
                stage, count = self._stage_of(scenes), sum(instance.count for instance in instances)
                output = stage.render(
                    instances, wanted.camera, sky=wanted.sky, near=wanted.near, distance=wanted.distance
                )
                ms_motion = stage.ms_motion
                added = further_layers.draw(stage, wanted, instances, scenes)
            else:
                output, ms_motion, count = self._play(wanted, wanted.t, scenes[wanted.scene])
        except (ValueError, OverflowError, FloatingPointError) as error:  # Gaussians out of the numeric range
            raise errors.ConfigError(f"worker: this picture cannot be drawn: {error}") from error
        ms_raster = watch.lap() - ms_motion
        arrays = {"color": output.color}
        for name in wanted.want:
            value = output.ids if name in ("ids", "owners") else getattr(output, name)
            arrays[name] = 0 * output.alpha if value is None else value  # no hold-outs
        arrays |= added
        result = {"ms_motion": ms_motion, "ms_raster": ms_raster, "gaussians": count, "scenes": self._known(wanted)}
        return result, arrays

    def _known(self, wanted: messages.RenderRequest) -> list[dict[str, Any]]:
        """Return the known error of each scene and the number of its Gaussians with unapplied residuals."""
        bent = {one.scene for one in wanted.instances if one.t is not None}
        playing = wanted.t is not None
        return [
            {"name": scene.name, "error": known.text(), "unbent": 0 if playing or k in bent else known.bending}
            for k, (scene, known) in enumerate(zip(self._scenes.values(), self._errors, strict=True))
        ]

    def _stage_of(self, scenes: list[Scene]) -> IncrementalRenderer:
        """Renderer of the loaded scenes, created again when they change."""
        from ..render import incremental_renderer

        if self._stage is None or self._staged is not scenes:
            self._stage, self._staged = incremental_renderer.IncrementalRenderer(scenes), scenes
        return self._stage

    def _play(self, wanted: messages.RenderRequest, t: float, scene: Scene):
        """Render a scene at a time; returns the output, milliseconds of motion, and the number of Gaussians."""
        from ..raster import RasterSettings
        from ..render import scene_renderer

        watch = timing.Stopwatch()
        if wanted.scene not in self._players:
            self._players[wanted.scene] = scene_player.Player(scene)
        pose = posed_scene.pose_frame(scene, self._players[wanted.scene].frame(t, wanted.camera.center))
        ms_motion = watch.lap()
        output = scene_renderer.render_frame(
            scene,
            pose,
            wanted.camera,
            background=None if wanted.sky is None else "scene",
            settings=RasterSettings(near_plane=scene.near_plane if wanted.near is None else wanted.near),
        )
        return output, ms_motion, len(pose.means)

    def _warm_up(self, _: dict[str, Any]) -> Answer:
        """Load the rasterizer; returns the number of kernels that this process ``compiled``."""
        self._wait_for_kernels()
        from ..raster import compilation
        from ..render import warm_up

        warm_up.warm_up(gradients=False)
        return {"compiled": compilation.compiled()}, {}

    def _check(self, _: dict[str, Any]) -> Answer:
        """Return versions, device and render time of a synthetic picture (ms), and the result of ``warm_up``."""
        warm, _ = self._warm_up({})
        from ..render import speed_test

        found = speed_test.run()
        versions = {"Python": platform.python_version(), "R5DGS": __version__}
        there = [name for name in ("torch", *NEEDED) if importlib.util.find_spec(name) is not None]
        versions |= {name: importlib.metadata.version(name) for name in there}
        return {**warm, "versions": versions, **dataclasses.asdict(found)}, {}

    def _query(self, request: dict[str, Any]) -> Answer:
        """Return the objects of a loaded ``scene`` (the first by default) that match ``text``, ranked.

        ``encoder``: folder of the encoder that made the scene's lookup table, or "text", for words that the scene does
        not store; null for none.
        """
        scene = self._loaded()[fields.number_of(request, self._numbers)]
        text = fields.need(request, "text", str)
        encoder = None if request.get("encoder") is None else self._opened(request)
        found = query.find(scene, text, encoder)
        return {"matches": [dataclasses.asdict(match) for match in found]}, {}

    def _embed(self, request: dict[str, Any]) -> Answer:
        """Return embeddings of the phrases ``texts`` by ``encoder`` (see `_query`), and the identity of the encoder."""
        texts = fields.texts_of(request)
        encoder = self._opened(request)
        card = encoder.card
        known = {"kind": card.kind, "name": card.name, "digest": card.digest, "dimension": card.dimension}
        return {"encoder": known}, {"embeddings": encoder_base.embed_phrases(encoder, texts)}

    def _export(self, request: dict[str, Any]) -> Answer:
        """Return the ``files`` that an export writes; see `scene_export.write`. The loaded scenes stay."""
        return {"files": scene_export.write(request)}, {}

    def _contact(self, request: dict[str, Any]) -> Answer:
        """Predict motions with contacts; see `contact_prediction.predict`. The loaded scenes stay."""
        from . import contact_prediction

        self._wait_for_kernels()
        return contact_prediction.predict(request), {}

    def _opened(self, request: dict[str, Any]) -> encoder_base.Encoder:
        """Return the requested encoder; the last one stays open."""
        where = fields.path_of(request.get("encoder"), "encoder")
        if self._encoder is None or self._encoder[0] != where:
            self._encoder = None  # free its memory before the next one is opened
            self._encoder = where, registry.open_encoder(where)
        return self._encoder[1]

    def _loaded(self) -> list[Scene]:
        if not self._scenes:
            raise errors.ConfigError("worker: no scene is loaded; send 'load' first")
        return list(self._scenes.values())

    def _wait_for_kernels(self) -> None:
        if self._warming is not None:
            self._warming.wait()


def serve(requests: BinaryIO, answers: BinaryIO, *, warm: bool = False) -> bool:
    """Answer requests until the end of the input or a ``shutdown`` request.

    Args:
        requests: Stream of JSON lines.
        answers: Stream for the responses.
        warm: Load the rasterizer after the first response; see `WarmUpThread`.

    Returns:
        True if the rasterizer is still loading.
    """
    lock = threading.Lock()

    def send(header: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> None:
        with lock:
            wire.write(answers, header, arrays or {})

    def send_event(event: dict[str, Any]) -> None:
        with contextlib.suppress(OSError, ValueError):  # the client has closed the stream
            send(event)

    warming = WarmUpThread(send_event) if warm else None
    server = Server(warming)
    while True:
        number = None
        try:
            line = fields.read_line(requests)
            if not line:
                break
            if not line.strip():
                continue
            request = fields.parse(line)
            number = fields.id_of(request)
            if fields.command_of(request) == "shutdown":
                send({"id": number, "ok": True, "result": {}})
                break
            result, arrays = server.answer(request)
        except errors.R5dgsError as error:
            send(_failure(number, type(error).__name__, str(error)))
        except Exception as error:  # the worker outlives a failed request; the traceback goes to its log
            traceback.print_exc()
            send(_failure(number, "BackendError", f"worker: the request failed: {type(error).__name__}: {error}"))
        else:
            send({"id": number, "ok": True, "result": result}, arrays)
        if warming is not None:
            warming.start()
    return warming is not None and warming.busy


def _failure(number: Any, kind: str, message: str) -> dict[str, Any]:
    return {"id": number, "ok": False, "error": {"kind": kind, "message": message}}


def main() -> None:
    """Serve on standard input and output; all other output goes to standard error."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    if serve(sys.stdin.buffer, answers, warm=True):
        sys.stderr.flush()
        os._exit(0)  # a compiling thread can neither be stopped nor outlive the interpreter


if __name__ == "__main__":
    main()

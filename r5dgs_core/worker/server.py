"""Worker process of the Blender add-on: ``python -m r5dgs_core.worker.server``.

Requests are JSON lines on standard input. Each response is one JSON line on standard output, followed by the raw bytes
of the arrays that the line announces, in order:

    -> {"id": 1, "command": "render", ...}
    <- {"id": 1, "ok": true, "result": {...}, "arrays": [{"name": "color", "dtype": "<f4", "shape": [H, W, 3]}]} + bytes
    <- {"id": 1, "ok": false, "error": {"kind": "SceneFileError", "message": "..."}}

The scenes of the last ``load`` stay in memory. The worker exits at the end of its input. Torch and the rasterizer are
imported lazily, after the first response, so that ``hello`` can report missing packages. Kernels are then loaded in a
background thread; render requests block until it finishes. If kernels have to be compiled, events without an id are
sent between responses:

    <- {"event": "compiling", "text": "rasterizer: compiling ...", "arrays": []}
    <- {"event": "ready", "seconds": 7.9, "arrays": []}
    <- {"event": "failed", "text": "LoweringError: ...", "arrays": []}     (instead of "ready")
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from .. import __version__, errors
from ..language import query
from ..language.encoders import encoder_base, registry
from ..playback import scene_player
from ..scene import quality, scene_file
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import edited_points
from . import requests as asked

if TYPE_CHECKING:
    from ..render import scene_renderer

PROTOCOL = 4
NEEDED = ("torch", "numba")

Answer = tuple[dict[str, Any], dict[str, np.ndarray]]


class Warming:
    """Background thread that loads or compiles the rasterizer's kernels.

    Args:
        tell: Called from that thread with an event when compilation starts, and when it is done or has failed.
    """

    def __init__(self, tell: Callable[[dict[str, Any]], None]):
        self._tell = tell
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread, unless it was started before."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="r5dgs warm-up", daemon=True)
            self._thread.start()

    def wait(self) -> None:
        """Block until the thread has finished; return at once if it was not started."""
        if self._thread is not None:
            self._thread.join()

    @property
    def busy(self) -> bool:
        """True if the thread is running."""
        return self._thread is not None and self._thread.is_alive()

    def _run(self) -> None:
        try:
            from ..raster import compilation
            from ..render import warm_up
        except (ImportError, errors.ConfigError):  # the next render request reports it
            return
        try:
            with compilation.telling(lambda text: self._tell({"event": "compiling", "text": text})):
                over = {"event": "ready", "seconds": round(warm_up.warm_up(gradients=False), 2)}
        except Exception as error:  # the next render request meets it again; the traceback goes to the log
            traceback.print_exc()
            over = {"event": "failed", "text": f"{type(error).__name__}: {error}"}
        if compilation.compiled():  # every "compiling" event is followed by "ready" or "failed"
            self._tell(over)


class Server:
    """Request handler that holds the scenes of the last ``load``.

    Args:
        warming: Thread to wait for before the first picture.
    """

    def __init__(self, warming: Warming | None = None) -> None:
        self._warming = warming
        self._scenes: dict[tuple[str, int, int], Scene] = {}  # by path, time and size of the file; in load order
        self._failed: dict[tuple[str, int, int], str] = {}  # stamp and error of the last unreadable file
        self._points = edited_points.EditedPoints()
        self._stage = None  # incremental renderer of `_staged`, created with the first picture
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
        return self._commands[asked.command_of(request)](request)

    def _hello(self, _: dict[str, Any]) -> Answer:
        missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
        return {"protocol": PROTOCOL, "python": platform.python_version(), "missing": missing, "pid": os.getpid()}, {}

    def _load(self, request: dict[str, Any]) -> Answer:
        """Load the scene files ``paths`` in this order; keeps those already loaded and drops all others."""
        paths = asked.need(request, "paths", list)
        named = [asked.stamp_of(path) for path in paths]
        stamps = list(dict.fromkeys(named))  # read a repeated file once
        if stamps != list(self._scenes):
            known, self._scenes, self._numbers, self._stage, self._players = self._scenes, {}, [], None, {}
            known = {stamp: scene for stamp, scene in known.items() if stamp in stamps}  # free memory before reading
            found = {stamp: known.get(stamp) or self._read(stamp) for stamp in stamps}
            self._errors = [quality.of(scene, Path(stamp[0])) for stamp, scene in found.items()]
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
        """Rasterize the loaded scenes, as instances or by playback.

        Fields of the request:
            camera: ``width height intrinsics T_cam_world``, OpenCV axes, in the world of the picture.
            instances: List of ``scene start count matrix world tint t holdout``. Each entry is a range of Gaussians of
                a scene. ``matrix`` [4, 4] maps their bind state to the world of the picture; ``world`` [4, 4] maps the
                scene's own world, which turns the view-dependent color (default: ``matrix``); ``tint`` scales the
                color; ``t`` is the scene time at which residuals are evaluated. ``points`` replaces ``start count`` and
                names an edit of a ``points`` request. An instance with ``holdout`` is black and appears in no array but
                ``holdout``, its share of each pixel.
            t: Scene time for playback of ``scene`` in its own world, instead of ``instances``.
            sky: Null for black, or ``scene matrix``; with ``t``, the sky of that scene by default.
            near: Nearest depth to render; the near plane of each scene by default.
            distance: Offset from the camera at which depth starts.
            want: Any of ``depth alpha owners holdout``; with ``t``, ``ids`` instead of ``owners holdout``. ``owners``
                and ``ids`` are the instance or object with the largest share of each pixel, -1 for none.
            coverage: ``groups`` (a number per instance, -1 for none) and ``ranks``. Adds the arrays ``coverage_groups``
                and ``coverage``: the groups with the largest share of each pixel.
        """
        scenes = self._loaded()
        camera = asked.camera_of(asked.need(request, "camera", dict))
        moved = "instances" in request
        want = asked.wanted(request, ("alpha", "depth", *(("owners", "holdout") if moved else ("ids",))))
        near, coverage = asked.near_of(request), asked.coverage_of(request)
        t = 0.0 if moved else asked.time_of(request)
        asked.check_size(camera, 0, 0 if coverage is None else coverage[1])
        scene_render = self._rasterizer()
        started = time.perf_counter()
        instances = []
        if moved:
            entries = asked.need(request, "instances", list)
            scenes, places = self._points.extend(scenes, edited_points.wanted(entries, self._numbers))
            instances = [edited_points.instance_of(entry, self._numbers, places) for entry in entries]
            asked.check_rows(instances, [len(scene.gaussians.means) for scene in scenes])
            shown = sum(instance.count for instance in instances)
            asked.check_size(camera, shown, 0 if coverage is None else coverage[1])
        try:
            if moved:
                output, ms_motion, count = self._instances(request, instances, scenes, camera, near)
            else:
                output, ms_motion, count = self._playback(request, t, scenes, camera, near)
            covered = {} if coverage is None else self._coverage(*coverage, instances, camera, near)
        except (ValueError, OverflowError, FloatingPointError) as error:  # Gaussians out of the numeric range
            raise errors.ConfigError(f"worker: this picture cannot be drawn: {error}") from error
        ms_raster = 1e3 * (time.perf_counter() - started) - ms_motion
        arrays = {"color": scene_render.to_numpy(output.color, np.float32)}
        for name in want:
            value = output.ids if name in ("ids", "owners") else getattr(output, name)
            value = 0 * output.alpha if value is None else value  # no hold-outs
            arrays[name] = scene_render.to_numpy(value, np.int32 if value is output.ids else np.float32)
        arrays |= covered
        result = {"ms_motion": ms_motion, "ms_raster": ms_raster, "gaussians": count, "scenes": self._known(request)}
        return result, arrays

    def _coverage(
        self,
        groups: list[int],
        ranks: int,
        instances: list[scene_renderer.Instance],
        camera: Camera,
        near: float | None,
    ) -> dict[str, np.ndarray]:
        """Return the groups of instances that share each pixel, and their shares."""
        assert self._stage is not None  # created by `_instances`
        found, shares = self._stage.coverage(instances, groups, camera, ranks=ranks, near=near)
        return {"coverage_groups": found, "coverage": shares}

    def _known(self, request: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the known error of each scene and the number of its Gaussians with unapplied residuals."""
        shown = request.get("instances", ())
        bent = {self._numbers[entry.get("scene", 0)] for entry in shown if entry.get("t") is not None}
        return [
            {"name": scene.name, "error": known.text(), "unbent": 0 if "t" in request or k in bent else known.bending}
            for k, (scene, known) in enumerate(zip(self._scenes.values(), self._errors, strict=True))
        ]

    def _instances(
        self,
        request: dict[str, Any],
        instances: list[scene_renderer.Instance],
        scenes: list[Scene],
        camera: Camera,
        near: float | None,
    ):
        from ..render import incremental_renderer

        behind = asked.sky_of(request, self._numbers)
        sky = None if behind is None else incremental_renderer.Sky(*behind)
        if self._stage is None or self._staged is not scenes:
            self._stage, self._staged = incremental_renderer.Stage(scenes), scenes
        output = self._stage.render(instances, camera, sky=sky, near=near, distance=asked.distance_of(request))
        return output, self._stage.ms_motion, sum(instance.count for instance in instances)

    def _playback(self, request: dict[str, Any], t: float, scenes: list[Scene], camera: Camera, near: float | None):
        from ..raster import RasterSettings
        from ..render import scene_renderer

        started = time.perf_counter()
        number = asked.number_of(request, self._numbers)
        scene = scenes[number]
        if number not in self._players:
            self._players[number] = scene_player.Player(scene)
        pose = scene_renderer.pose_frame(scene, self._players[number].frame(t, camera.center))
        ms_motion = 1e3 * (time.perf_counter() - started)
        output = scene_renderer.render_frame(
            scene,
            pose,
            camera,
            background="scene" if request.get("sky", {}) is not None else None,
            settings=RasterSettings(near_plane=scene.near_plane if near is None else near),
        )
        return output, ms_motion, len(pose.means)

    def _warm_up(self, _: dict[str, Any]) -> Answer:
        """Load the rasterizer; returns the number of kernels that this process ``compiled``."""
        self._rasterizer()
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
        versions |= {name: importlib.metadata.version(name) for name in NEEDED}
        return {**warm, "versions": versions, **dataclasses.asdict(found)}, {}

    def _query(self, request: dict[str, Any]) -> Answer:
        """Return the objects of a loaded ``scene`` (the first by default) that match ``text``, ranked.

        ``encoder``: folder of the encoder that made the scene's lookup table, or "text", for words that the scene does
        not store; null for none.
        """
        scene = self._loaded()[asked.number_of(request, self._numbers)]
        text = asked.need(request, "text", str)
        encoder = None if request.get("encoder") is None else self._opened(request)
        found = query.find(scene, text, encoder)
        return {"matches": [dataclasses.asdict(match) for match in found]}, {}

    def _embed(self, request: dict[str, Any]) -> Answer:
        """Return embeddings of the phrases ``texts`` by ``encoder`` (see `_query`), and the identity of the encoder."""
        texts = asked.texts_of(request)
        encoder = self._opened(request)
        card = encoder.card
        known = {"kind": card.kind, "name": card.name, "digest": card.digest, "dimension": card.dimension}
        return {"encoder": known}, {"embeddings": encoder_base.embed_phrases(encoder, texts)}

    def _opened(self, request: dict[str, Any]) -> encoder_base.Encoder:
        """Return the requested encoder; the last one stays open."""
        where = asked.path_of(request.get("encoder"), "encoder")
        if self._encoder is None or self._encoder[0] != where:
            self._encoder = None  # free its memory before the next one is opened
            self._encoder = where, registry.open_encoder(where)
        return self._encoder[1]

    def _loaded(self) -> list[Scene]:
        if not self._scenes:
            raise errors.ConfigError("worker: no scene is loaded; send 'load' first")
        return list(self._scenes.values())

    def _rasterizer(self):
        """Return `render.scene_renderer` after its kernels are loaded."""
        if self._warming is not None:
            self._warming.wait()
        return _rasterizer()


def _rasterizer():
    """Return `render.scene_renderer`, whose import needs torch and numba."""
    try:
        from ..render import scene_renderer
    except ImportError as error:
        raise errors.BackendError(
            f"worker: {sys.executable} lacks '{error.name}'; install the core there ('pip install r5dgs')"
        ) from error
    return scene_renderer


def serve(requests: BinaryIO, answers: BinaryIO, *, warm: bool = False) -> bool:
    """Answer requests until the end of the input or a ``shutdown`` request.

    Args:
        requests: Stream of JSON lines.
        answers: Stream for the responses.
        warm: Load the rasterizer after the first response; see `Warming`.

    Returns:
        True if the rasterizer is still loading.
    """
    lock = threading.Lock()

    def send(header: dict[str, Any], arrays: dict[str, np.ndarray] | None = None) -> None:
        with lock:
            _send(answers, header, arrays or {})

    def tell(event: dict[str, Any]) -> None:
        with contextlib.suppress(OSError, ValueError):  # the client has closed the stream
            send(event)

    warming = Warming(tell) if warm else None
    server = Server(warming)
    while True:
        number = None
        try:
            line = asked.read_line(requests)
            if not line:
                break
            if not line.strip():
                continue
            request = asked.parse(line)
            number = asked.id_of(request)
            if asked.command_of(request) == "shutdown":
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


def _send(answers: BinaryIO, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    entries = [{"name": n, "dtype": a.dtype.str, "shape": list(a.shape)} for n, a in arrays.items()]
    answers.write(json.dumps({**header, "arrays": entries}).encode() + b"\n")
    for array in arrays.values():
        answers.write(np.ascontiguousarray(array).tobytes())
    answers.flush()


def main() -> None:
    """Serve on standard input and output; all other output goes to standard error."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    if serve(sys.stdin.buffer, answers, warm=True):
        sys.stderr.flush()
        os._exit(0)  # a compiling thread can neither be stopped nor outlive the interpreter


if __name__ == "__main__":
    main()

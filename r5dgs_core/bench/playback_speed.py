"""Playback speed of a scene: complete frames along its test views, in sequence, as in a player."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import timing
from ..data.dataset import View
from ..playback import scene_player
from ..render import scene_renderer
from ..scene.scene import Scene

MIN_FRAMES = 60  # per mode, unless the time limit is reached
TIME_LIMIT_S = 20.0  # per mode


def measure(
    scene: Scene, views: Sequence[View], modes: Sequence[str], *, backend: str = "auto"
) -> dict[str, dict[str, Any]]:
    """Time frames of a scene, from scene time to the color image in host memory, without identity encodings.

    The views are played camera by camera in order of time, repeatedly until there are enough frames. The modes are
    timed in interleaved rounds, so that background load affects all of them equally. The first round of each is not
    counted, because it loads kernels and fills caches.

    Args:
        views: Cameras and times.
        modes: Playback modes from `scene_player.modes`.

    Returns:
        By mode ``fps`` (frames per second by the median), medians ``ms_frame``, ``ms_motion`` and ``ms_raster``,
        ``ms_cpu`` (processor time per frame, over all threads), ``ms_frame_low`` and ``ms_frame_high`` (10th and 90th
        percentile), and ``frames``. All but the last are None without views.
    """
    ordered = sorted(views, key=lambda view: (view.camera.name, view.t))
    times: dict[str, list[tuple[float, float, float]]] = {mode: [] for mode in modes}
    if not ordered:
        return {mode: _summary(found) for mode, found in times.items()}
    players = {mode: scene_player.Player(scene, mode) for mode in modes}
    for player in players.values():
        for view in ordered:
            _draw(player, view, backend)
    began = time.monotonic()
    for taken in itertools.count():
        in_time = time.monotonic() - began < TIME_LIMIT_S * len(modes)
        if taken * len(ordered) >= MIN_FRAMES or (taken and not in_time):
            break
        for mode, found in times.items():
            found += [_draw(players[mode], view, backend) for view in ordered]
    return {mode: _summary(found) for mode, found in times.items()}


def _summary(times: Sequence[tuple[float, float, float]]) -> dict[str, Any]:
    """Return the values of `measure` for one mode, from motion, rasterization and processor times of its frames."""
    names = ("fps", "ms_frame", "ms_motion", "ms_raster", "ms_cpu", "ms_frame_low", "ms_frame_high")
    if not times:
        return {**dict.fromkeys(names), "frames": 0}
    motion, raster, cpu = np.array(times).T
    low, middle, high = np.percentile(motion + raster, (10, 50, 90))
    medians = (np.median(motion), np.median(raster), np.median(cpu))
    values = (1e3 / middle, middle, *medians, low, high)
    return {**dict(zip(names, map(float, values), strict=True)), "frames": len(times)}


def _draw(player: scene_player.Player, view: View, backend: str) -> tuple[float, float, float]:
    """Return the time of motion and of rasterization, and the processor time, of one frame in milliseconds."""
    cpu, watch = time.process_time(), timing.Stopwatch()
    frame = player.frame(view.t, view.camera.center)
    ms_motion = watch.lap()
    scene_renderer.render_frame(player.scene, frame, view.camera, backend=backend)
    return ms_motion, watch.lap(), 1e3 * (time.process_time() - cpu)

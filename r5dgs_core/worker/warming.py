"""Background thread that loads or compiles the rasterizer's kernels while the worker answers other requests."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from typing import Any

from .. import errors


class WarmUpThread:
    """Background thread that loads or compiles the rasterizer's kernels.

    Args:
        on_event: Called from that thread with an event when compilation starts, at each later stage, and when it is
            done or has failed.
    """

    def __init__(self, on_event: Callable[[dict[str, Any]], None]):
        self._on_event = on_event
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
        begun, step = False, 0

        def announce(text: str) -> None:
            nonlocal begun
            begun = True
            self._on_event({"event": "compiling", "text": text})

        def progress(stage: str) -> None:
            nonlocal step
            step += 1
            if begun:
                self._on_event({"event": "progress", "text": stage, "step": step, "steps": warm_up.count(False)})

        try:
            with compilation.announcing(announce):
                over = {"event": "ready", "seconds": round(warm_up.warm_up(gradients=False, progress=progress), 2)}
        except Exception as error:  # the next render request raises the same error; the traceback goes to the log
            traceback.print_exc()
            over = {"event": "failed", "text": f"{type(error).__name__}: {error}"}
        if compilation.compiled():  # every "compiling" event is followed by "ready" or "failed"
            self._on_event(over)

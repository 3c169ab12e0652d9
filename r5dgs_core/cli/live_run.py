"""Live view of a training run: bakes its checkpoints in a process of low priority, and finds the files to show.

Imports only the standard library, so that the viewing process takes no memory from the training.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .page_server import Page

EVERY_S = 60.0  # shortest time from the start of a bake to the start of the next
SHARE = 0.1  # largest share of one core's time for bakes, which slow the training by the use of shared caches
POLL_S = 2.0
RETRY_S = 300.0  # from the start of a bake that failed to the next of the same checkpoint
PAGE = Path(__file__).with_name("live_run.html")
CHECKPOINT, CURVES, LOG = "checkpoint.pt", "learning_curves.png", "log.jsonl"  # of run folders
SCENE, SHEET = "scene.html", "contact_sheet.png"  # made by `live_bake`
_TAIL = 4096  # bytes at the end of the log that hold its last line


class LiveRun:
    """A run folder and the latest files that were made of it.

    Args:
        run: The run folder.
        folder: Folder for the files, for this process alone.
        arguments: Further arguments of `live_bake`.
        idle: True to bake only in time that no other process wants.
    """

    def __init__(self, run: Path, folder: Path, arguments: Sequence[str] = (), *, idle: bool = True):
        self.run, self.folder, self._idle = run, folder, idle
        self._arguments = ["--end-with-input", *arguments, *(["--idle"] if idle else [])]
        self._baked: tuple[int, int] | None = None  # size and time of the checkpoint of the last bake
        self._count, self._problem, self._busy = 0, "", False
        self._stop, self._process = threading.Event(), None
        self._starting = threading.Lock()  # held while a process is started, so that `stop` ends every process

    def find(self, path: str) -> Page | None:
        """Return a page of the live view; see `page_server.serving`."""
        if path == "/":
            return Page(PAGE.read_bytes())
        if path == "/state":
            return Page(json.dumps(self.state()).encode(), "application/json")
        files = {
            "/scene": (self.folder / SCENE, "text/html; charset=utf-8"),
            "/sheet": (self.folder / SHEET, "image/png"),
            "/curves": (self.run / CURVES, "image/png"),
        }
        file, kind = files.get(path, (None, ""))
        try:
            return None if file is None else Page(file.read_bytes(), kind)
        except OSError:
            return None

    def state(self) -> dict[str, Any]:
        """Return the number of finished bakes, the last line of the log, and the reason if no bake succeeds."""
        return {
            "run": self.run.name,
            "bakes": self._count,
            "baking": self._busy,
            "idle": self._idle,
            "problem": self._problem,
            "log": _last_line(self.run / LOG),
            "curves": _stamp(self.run / CURVES),
        }

    def watch(self) -> None:
        """Bake each new checkpoint, within `EVERY_S` and `SHARE`, until `stop`; a failed bake again after `RETRY_S`."""
        again = 0.0
        while not self._stop.is_set():
            stamp = _stamp(self.run / CHECKPOINT)
            wait = POLL_S
            if stamp is None:
                self._problem = "no checkpoint yet"
            elif stamp != self._baked or (self._problem and time.monotonic() >= again):
                again = time.monotonic() + RETRY_S
                began, spent = time.monotonic(), _children_seconds()
                self._bake()
                self._baked = stamp
                took, spent = time.monotonic() - began, _children_seconds() - spent
                wait = max(max(EVERY_S, (spent or took) / SHARE) - took, POLL_S)
            self._stop.wait(wait)

    def stop(self) -> None:
        """End `watch` and its process."""
        self._stop.set()
        with self._starting:
            if self._process is not None:
                self._process.kill()

    def _bake(self) -> None:
        command = [sys.executable, "-m", "r5dgs_core.cli.live_bake", str(self.run), str(self.folder), *self._arguments]
        one = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        package = str(Path(__file__).parents[2])
        paths = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH", ""))))
        settings = {**os.environ, **one, "PYTHONPATH": paths, "CUDA_VISIBLE_DEVICES": ""}
        with self._starting:
            if self._stop.is_set():
                return
            self._busy = True
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                env=settings, text=True, start_new_session=True,
            )  # fmt: skip
        with self._process:  # closes the input, which ends the bake, only after its last line
            assert self._process.stderr is not None
            log = self._process.stderr.read()
        self._busy = False
        if self._process.returncode == 0:
            self._count, self._problem = self._count + 1, ""
        else:
            self._problem = (log.strip().splitlines() or ["the scene could not be made"])[-1][:300]


def _children_seconds() -> float:
    """Return the processor seconds of finished child processes; 0 on systems that do not count them."""
    spent = os.times()
    return spent.children_user + spent.children_system


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return size and time of a file, None if it is missing."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _last_line(path: Path) -> dict[str, Any] | None:
    """Return the last complete line of a log, None if there is none."""
    try:
        with open(path, "rb") as stream:
            stream.seek(max(stream.seek(0, os.SEEK_END) - _TAIL, 0))
            lines = stream.read().split(b"\n")[:-1]
        found = json.loads(lines[-1])
        return found if isinstance(found, dict) else None
    except (OSError, ValueError, IndexError):
        return None
